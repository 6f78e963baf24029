"""What the core process does besides measuring: jobs that people start, the web process, and what an earlier end has left open."""
