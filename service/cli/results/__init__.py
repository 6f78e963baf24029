"""Commands that solve, search, show and report what was measured."""
