"""What a robot sees of a plant's fruit, and what the plant makes of it."""
