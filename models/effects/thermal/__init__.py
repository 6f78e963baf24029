"""Effects of warming: one file per effect."""
