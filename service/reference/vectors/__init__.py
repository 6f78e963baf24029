"""Readers of the independent vector files; each compares the stored numbers with computed ones."""
