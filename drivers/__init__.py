"""Drivers know bytes: async conversations with instruments and controllers, nothing about physics or jobs."""
