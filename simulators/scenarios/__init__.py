"""Packaged scenarios (TOML): the machine, how large its errors may be, and how its devices are reached."""
