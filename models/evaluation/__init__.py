"""Evaluation of measurements by the standards that people sign for: ISO 230-2, 230-4 and 230-6. Pure, mm and rad."""
