"""Discovery: where simulation and measurement disagree, and which physical effect is missing. Pure functions of arrays."""
