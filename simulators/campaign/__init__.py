"""Measurement campaigns on simulated machines without device protocols, for statistics over many machines."""
