"""The operator's screens beside the home page: read from the store, written on the server in the reader's language."""
