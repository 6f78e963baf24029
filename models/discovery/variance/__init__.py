"""Variance effects: positions, times and frequencies at which readings scatter more than noise."""
