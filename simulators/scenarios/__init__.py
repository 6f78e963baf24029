"""Packaged scenarios (TOML): which machine stands there, how wrong it may be, and how it is reached."""
