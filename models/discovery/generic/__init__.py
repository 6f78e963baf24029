"""A signal that no effect of the catalogue explains: its shape and place."""
