"""Work of the service as jobs: a check, a guided campaign, an investigation."""
