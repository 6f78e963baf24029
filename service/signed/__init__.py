"""Signed compensation files: contents, machine, base table, limits, expiry and signer."""
