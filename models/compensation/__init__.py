"""From error parameters to what a controller stores, and what will be left after it."""
