"""The database: a `Store` opened by URL, with one writer thread and schema migrations."""
