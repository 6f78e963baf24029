"""The read model: one query for every list and every detail. Pages, HTTP, command line, OPC UA and MTConnect only format the results."""
