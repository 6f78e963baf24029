"""The compensation table in force, its history and its verification. Writes nothing to a controller."""
