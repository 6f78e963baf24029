"""The audit: who did what, when, on what, how it ended; each record chained to the one before it and sealed with a key outside."""
