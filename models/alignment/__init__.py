"""Clocks of devices and this computer: what time a sample was taken at, and where the machine was then."""
