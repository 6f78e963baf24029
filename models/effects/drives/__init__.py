"""Effects of drives and controls: one file per effect."""
