"""Login with passwords, sessions and tokens, and the permissions of routes."""
