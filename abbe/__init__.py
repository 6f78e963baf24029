"""Abbe: how a 3-axis machine really moves, and its correction. The parts are links to the folders beside this one (decision 0031)."""
