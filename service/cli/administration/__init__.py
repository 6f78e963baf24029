"""Commands for who runs the service: users, backup, audit, keys, fleet, alarms."""
