"""Read-only interfaces for the plant's programs: facts of the machine, an OPC UA server, MTConnect documents."""
