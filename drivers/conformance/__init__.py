"""`abbe device test`: test of a device, and of its driver with late, doubled, spoilt and missing replies."""
