"""Physical effects beyond the smooth error motions: one file each, declared so that one runner tests them all."""
