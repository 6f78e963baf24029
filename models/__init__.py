"""Models know physics: pure functions of numpy arrays, no I/O, clock or logging."""
