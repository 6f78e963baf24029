"""The database: one Store, opened by URL, with one writer thread and schema migrations from the first table on."""
