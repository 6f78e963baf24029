"""The web process: entry point, import guard and server."""
