"""The audit: who did what to what, when, and how it ended. Each record is chained to the one before and sealed with a key kept outside."""
