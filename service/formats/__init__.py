"""Conversion of `Compensation` to the table files of controls and back: one module per format."""
