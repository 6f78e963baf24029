"""Kwon 2004: the 3-PUU parallel machine, its frames, response surface and kinematic calibration."""
