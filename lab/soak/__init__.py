"""Deterministic simulation of the whole mesh with faults, judged from outside (`garden soak`; docs/reliability.md)."""
