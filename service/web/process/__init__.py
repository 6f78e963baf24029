"""The web process itself: its start, its guard of imports, its server."""
