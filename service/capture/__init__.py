"""Writes device data to disk before any other use of it (docs/decisions/0013-segments-before-the-database.md)."""
