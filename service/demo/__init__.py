"""Demonstrations: the whole job on simulated machines."""
