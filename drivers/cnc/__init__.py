"""The CNC controller on Modbus TCP (docs/protocols/cnc.md)."""
