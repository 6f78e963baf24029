"""Comparison of computed numbers with those printed in four papers (`papers`) and those in independent vector files (`vectors`)."""
