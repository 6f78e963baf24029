"""Solve observations for error parameters with uncertainty, and find what the observations cannot determine."""
