"""Pahk 1995, cited as P (equation): measurement off the origin, random errors, volumetric map and space diagonals."""
