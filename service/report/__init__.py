"""What the report of a run, campaign, solution, discovery, verification or push says."""
