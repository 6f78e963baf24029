"""Measuring campaigns on the simulated machine without any wire: for statistics over many machines."""
