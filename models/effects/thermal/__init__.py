"""Effects of warming: one file an effect."""
