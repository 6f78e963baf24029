"""What a result is worth: propagation and Monte Carlo of the uncertainty of predicted deviations."""
