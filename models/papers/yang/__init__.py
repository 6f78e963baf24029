"""Yang and Kim: 21-error and six-parameter volumetric models and the ball-bar observation (math.md 4)."""
