"""Effects of instruments and their set-up: one file per effect."""
