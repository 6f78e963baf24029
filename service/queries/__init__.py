"""The read model: every list and every detail once. Page, HTTP, command line, OPC UA and MTConnect only format what it returns."""
