"""The plant's side of the garden: a pot that watches its soil and asks for water, or a station with a tap and docks."""
