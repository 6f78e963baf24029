"""Generic structures for deviations that no effect of the catalogue explains."""
