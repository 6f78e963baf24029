"""The sealed truth: the real motion of the machine, which only the simulated instruments read."""
