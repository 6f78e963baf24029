"""Combinations of errors that a set of readings determines, those that it hides, and measurements that would show them."""
