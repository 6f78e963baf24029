"""Touch probes: tilt and roll frame, master-sphere calibration, lobing map (math.md 7)."""
