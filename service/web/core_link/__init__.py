"""Connection to the core process: its latest state, requests to it and live samples; also the log tail of the web process."""
