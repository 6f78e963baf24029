"""What the service speaks of: one record for each idea, from the core over the channel to page, JSON, OPC UA and MTConnect."""
