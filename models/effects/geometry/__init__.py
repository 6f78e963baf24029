"""Geometric errors of axes: one file per effect."""
