"""The sealed truth: the real motion of the machine. Instruments get to know it only through readings."""
