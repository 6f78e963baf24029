"""Wang: the sequential step diagonal, what tilt, angles and scale errors do to it (math.md 5)."""
