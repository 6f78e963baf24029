"""Computed numbers beside numbers from outside: the print of four papers (`papers`) and independent vector files (`vectors`)."""
