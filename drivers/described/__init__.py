"""Devices whose protocol is not built in, described by a file: Modbus registers, or lines of text."""
