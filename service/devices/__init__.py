"""Devices of one machine, opened and closed together."""
