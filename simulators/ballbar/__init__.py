"""Telescoping ball-bar: the instrument (device), its bytes (wire) and their line (port)."""
