"""What a device sent is on the disk before anything else is done with it (docs/decisions/0013-segments-before-the-database.md)."""
