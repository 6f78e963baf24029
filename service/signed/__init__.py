"""Signed compensation files: what is in them, for which machine, on which base, under which limits, until when, and who says so."""
