"""A plate of holes or balls on the simulated table, and the touch probe that measures it."""
