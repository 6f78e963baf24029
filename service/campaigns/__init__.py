"""Measuring: a recipe becomes runs in the store, complete or visibly not."""
