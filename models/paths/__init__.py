"""Geometry of the tests, shared by sequences and solvers."""
