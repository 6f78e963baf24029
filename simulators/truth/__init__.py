"""The sealed truth: how the machine really moves. Nothing here is told to any instrument except through a reading."""
