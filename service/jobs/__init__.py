"""What the service does as a job: a check, a guided campaign, an investigation, and what it looks for at start."""
