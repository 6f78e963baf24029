"""Runs: packing of samples, conversion to columns, and exchange files."""
