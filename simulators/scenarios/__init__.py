"""Packaged scenarios (TOML): the machine, the size of its errors, and the connections of its devices."""
