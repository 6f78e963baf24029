"""Experiment design: which further measurement would separate the remaining explanations."""
