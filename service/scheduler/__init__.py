"""Unattended checks: due slots, preconditions, and the outcome of each slot."""
