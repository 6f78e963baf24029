"""Duties of the core process besides measuring: jobs that people start, the web process, the watch over tables, recovery at start."""
