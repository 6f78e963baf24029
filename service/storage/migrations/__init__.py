"""Schema changes of the database, one revision a file, applied by service.storage.migrate when the store opens."""
