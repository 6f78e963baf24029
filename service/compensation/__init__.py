"""From a solution to a table in force: proposed, approved, pushed, verified, or rolled back."""
