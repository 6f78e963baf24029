"""Where simulation and measurement disagree, which effect is missing, and which measurement would show more."""
