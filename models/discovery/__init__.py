"""Discovery: where simulation and measurement disagree, which effect is missing, and what it changes. Pure: arrays in, findings out."""
