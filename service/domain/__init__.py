"""Domain records of the service, one for each concept. Core, channel, page, JSON, OPC UA and MTConnect all use the same records."""
