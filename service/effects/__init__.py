"""Machine effects beyond the 21 error motions: the catalogue, plug-ins, and the model book."""
