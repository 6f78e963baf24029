"""Hidden effects: what a real machine does beyond its smooth error motions, with memory and clock, and suites of sealed cases with them."""
