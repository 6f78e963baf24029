"""What is known of a machine beyond its 21 error motions: the catalogue, plug-ins, and the model book."""
