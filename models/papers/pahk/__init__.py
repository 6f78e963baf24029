"""Pahk 1995: what an instrument sees off the origin, random errors, volumetric map and space diagonals (math.md 2)."""
