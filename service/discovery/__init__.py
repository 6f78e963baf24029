"""Discovery: differences of simulation and measurement, the missing effect, and the measurement that would show more."""
