"""Recipes: the few parameters of a test, which become steps, and the files that hold recipes."""
