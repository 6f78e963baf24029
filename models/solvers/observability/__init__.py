"""What a set of readings can tell, and what it cannot, and what would cure it."""
