"""Seeing fruit: detectors as pure functions of an image, found by name, and how they are judged."""
