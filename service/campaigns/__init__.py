"""Measure the tests of a recipe and store them as runs; an incomplete run is marked as incomplete."""
