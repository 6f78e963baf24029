"""The service: measure, solve, compensate, verify, store and report."""
