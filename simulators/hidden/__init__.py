"""Hidden effects: errors of a real machine that depend on its history and on time, and suites of sealed cases that contain them."""
