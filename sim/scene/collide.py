"""Who touches whom: a contact exists where one's `contype` meets the other's `conaffinity`. Wheels go by explicit pairs."""

from __future__ import annotations

SHELL = 1
"""The round body of a robot, and its bumper."""
ARM = 8
FRUIT = 16

NOTHING = {"contype": 0, "conaffinity": 0}
A_SHELL = {"contype": SHELL, "conaffinity": SHELL | FRUIT}
AN_ARM = {"contype": ARM, "conaffinity": 0}
A_FRUIT = {"contype": FRUIT, "conaffinity": ARM | FRUIT}
FOR_FRUIT = {"contype": 0, "conaffinity": FRUIT}
"""Holds fruit up and is nothing to anything else: a basket, a deck, soil."""
GROUND = {"contype": 0, "conaffinity": SHELL | FRUIT}
FURNITURE = {"contype": 0, "conaffinity": SHELL | ARM | FRUIT}

VISUAL_GROUP = 1
HULL_GROUP = 3
"""Collision shapes that nobody sees."""
SITE_GROUP = 4
