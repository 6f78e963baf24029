"""`abbe device test`: what a device does, and what Abbe makes of late, doubled, spoilt and missing replies."""
