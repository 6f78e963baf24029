"""The HTTP interface `/api/v1`: what the store knows, and decisions on proposals. It moves nothing."""
