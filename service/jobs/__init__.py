"""Work of the service as jobs: a check, a guided campaign, an investigation, and the recovery at start."""
