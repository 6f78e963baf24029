"""Telescoping ball-bar: the instrument (device), its bytes (wire) and the line they go over (port)."""
