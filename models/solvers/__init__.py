"""From observations to error parameters with uncertainty, and to what the observations cannot tell."""
