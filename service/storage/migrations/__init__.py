"""Schema changes of the database, one revision a file, applied by abbe.service.storage.engine when the store opens."""
