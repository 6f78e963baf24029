"""The sealed truth: how the machine really moves. Instruments learn of it only through readings."""
