"""The jobs: measure, solve, compensate, verify, and the demonstration that strings them together."""
