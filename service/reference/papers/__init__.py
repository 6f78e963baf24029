"""Printed numbers of the four papers, how each is computed, and their pictures."""
