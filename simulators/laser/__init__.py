"""Laser displacement meter: the instrument (device) and its Modbus map (wire)."""
