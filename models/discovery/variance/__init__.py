"""Variance effects: where, when and at which frequency readings scatter more than noise."""
