"""Touch probes: tilt and roll frame, master-sphere calibration, lobing map."""
