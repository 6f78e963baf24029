"""Compensation tables as the files that controls read, and back: one module per format, text on one side, `Compensation` on the other."""
