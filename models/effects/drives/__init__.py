"""Effects of drives and controls: one file an effect."""
