"""Fault injection: proxies and lines between a device and its host that play a scenario."""
