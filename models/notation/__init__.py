"""One module per paper: its names and signs in ISO 230-1 (math.md 1)."""
