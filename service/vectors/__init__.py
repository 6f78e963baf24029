"""`abbe vectors`: check of the public functions with independent vector files."""
