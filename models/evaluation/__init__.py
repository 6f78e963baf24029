"""Evaluation of measurements by ISO 230-2, 230-4 and 230-6: pure functions, mm and rad."""
