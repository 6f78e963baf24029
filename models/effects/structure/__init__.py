"""Effects of bed, ram and guides: one file per effect."""
