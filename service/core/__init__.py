"""The core process besides measuring: jobs that people start, the web process, and recovery of what an earlier end left open."""
