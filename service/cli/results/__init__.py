"""Commands that solve, search, show and report measurements."""
