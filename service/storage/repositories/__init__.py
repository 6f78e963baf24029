"""Repositories, one file per aggregate: campaigns, runs, pushes, people and so on."""
