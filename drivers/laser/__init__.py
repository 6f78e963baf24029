"""The laser displacement meter on Modbus (docs/protocols/laser.md)."""
