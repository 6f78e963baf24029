"""A campaign as it was read: its runs, whether they can be what they say, and where they come from."""
