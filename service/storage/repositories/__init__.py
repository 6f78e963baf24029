"""One file per aggregate: what is read and written of campaigns, runs, pushes, people."""
