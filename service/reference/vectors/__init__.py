"""Readers of independent vector files: what each stored number is compared with."""
