"""Pahk 1995: measurement off the origin, random errors, volumetric map and space diagonals (math.md 2)."""
