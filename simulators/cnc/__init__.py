"""CNC controller: motion, compensation banks (device) and its Modbus TCP map (wire)."""
