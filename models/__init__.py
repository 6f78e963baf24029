"""The physics: pure functions of numpy arrays, without I/O, clock or logging."""
