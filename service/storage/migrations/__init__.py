"""Schema changes of the database, one revision a file, applied by abbe.service.storage.migrate when the store opens."""
