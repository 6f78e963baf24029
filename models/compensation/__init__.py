"""Compensation tables from identified error motions, and the errors that remain with them."""
