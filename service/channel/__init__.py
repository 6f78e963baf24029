"""The channel between the core process and the web process: typed messages and their transport."""
