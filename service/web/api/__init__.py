"""The HTTP interface `/api/v1`: stored data, and decisions on proposals. It moves no axis."""
