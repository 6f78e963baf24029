"""Contents of the reports of runs, campaigns, solutions, discoveries, verifications and pushes."""
