"""Effects of bed, ram and guides: one file an effect."""
