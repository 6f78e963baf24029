"""Drivers: async communication with instruments and controllers; they know bytes, but neither physics nor measuring jobs."""
