"""Unattended checks: when they are due, who may run, and what became of each slot."""
