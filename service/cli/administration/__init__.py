"""Commands for the person who runs the service: users, backup, audit, keys, fleet, alarms."""
