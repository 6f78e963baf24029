"""Physical effects beyond the smooth error motions: one file per effect; `self_test` checks all their declarations."""
