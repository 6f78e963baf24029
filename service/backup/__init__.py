"""Backup and restore of a database with its samples and its audit."""
