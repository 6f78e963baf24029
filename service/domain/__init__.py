"""Domain records of the service: one for each idea, used from the core over the channel to page, JSON, OPC UA and MTConnect."""
