"""What a set of readings determines, what it leaves hidden, and which additional measurements would show it."""
