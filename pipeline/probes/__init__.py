"""Probes: what stood in for the objects, and how the light is read from it. One class per kind, one contract."""
