"""Who touches whom: a contact exists where one's `contype` meets the other's `conaffinity`. Wheels go by explicit pairs."""

from __future__ import annotations

SHELL = 1
"""The round body of a robot, and its bumper."""
ARM = 8

NOTHING = {"contype": 0, "conaffinity": 0}
A_SHELL = {"contype": SHELL, "conaffinity": SHELL}
AN_ARM = {"contype": ARM, "conaffinity": 0}
GROUND = {"contype": 0, "conaffinity": SHELL}
FURNITURE = {"contype": 0, "conaffinity": SHELL | ARM}

VISUAL_GROUP = 1
HULL_GROUP = 3
"""Collision shapes that nobody sees."""
SITE_GROUP = 4
