"""What the plant's programs read: facts of the machine, an OPC UA server, MTConnect documents. Nothing comes in."""
