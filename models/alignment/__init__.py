"""When a sample was taken, by the clocks of devices and this computer, and where the machine was then."""
