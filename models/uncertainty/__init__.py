"""Uncertainty of predicted deviations: propagation and Monte Carlo."""
