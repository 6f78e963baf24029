"""Connection to the core process: its latest state, and the answer while it is unavailable."""
