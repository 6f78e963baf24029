"""Service knows the job: it measures, solves, compensates, verifies, stores and reports."""
