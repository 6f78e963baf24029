"""Shapes of axes beyond smooth error motions: one file an effect."""
