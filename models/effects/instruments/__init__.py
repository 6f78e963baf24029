"""Effects of instruments and their set-up: one file an effect."""
