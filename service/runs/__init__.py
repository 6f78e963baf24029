"""Runs: how samples are packed, how they become columns, and how they leave and enter as exchange files."""
