"""The audit: person, action, target, time and outcome. Each record is chained to the one before and sealed with a key kept outside."""
