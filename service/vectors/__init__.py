"""`abbe vectors`: independent vector files through the public functions."""
