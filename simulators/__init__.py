"""Simulators of the outside world: a machine tool with its errors, and the instruments that measure it."""
