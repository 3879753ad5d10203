"""The gardener's arm: kinematics, and clear ways past pot and dock."""
