"""Wang, cited as W (equation): the sequential step diagonal, and the effect of mirror tilt, angular and scale errors on it."""
