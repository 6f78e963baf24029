"""A campaign as read: its runs, their consistency, and their provenance."""
