"""Solve observations for error parameters with uncertainty, and find the parameters that the observations cannot determine."""
