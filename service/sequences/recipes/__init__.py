"""Which test is measured: a few numbers that become steps, and the files that hold them."""
