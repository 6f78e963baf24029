"""Which compensation table is in force, how it came there, and what verified it. Writes nothing to a controller."""
