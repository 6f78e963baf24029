"""The operator's screens besides the home page, rendered on the server from the store in the reader's language."""
