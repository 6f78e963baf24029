"""Demonstrations: measure, correct and verify simulated machines."""
