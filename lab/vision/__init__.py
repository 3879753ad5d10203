"""Seeing, tried out: labelled photographs, rendered frames, measuring, fitting and training."""
