"""Access rights: users, roles, passwords, sessions and tokens, independent of the web and the command line."""
