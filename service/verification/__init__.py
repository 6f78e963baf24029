"""Figures of checks against limits, ISO 230 figures, trends and alarms."""
