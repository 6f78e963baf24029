"""Who may do what: users, roles, passwords, sessions, tokens. Knows neither web nor command line."""
