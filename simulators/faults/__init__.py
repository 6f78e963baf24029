"""Faults on purpose: proxies and lines between a device and its host that do what a scenario says."""
