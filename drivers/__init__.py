"""Drivers: async communication with instruments and controllers; they know bytes, not physics or jobs."""
