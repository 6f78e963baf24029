"""Telemetry out by MQTT. Nothing comes in: no message can move a machine or push a table."""
