"""How a plant expects its fruit to grow and ripen between visits (paper 000, section 9). Pure Python: a pot runs it."""
