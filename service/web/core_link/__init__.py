"""The line to the core process: what it knows of the moment, and what is said while it is away."""
