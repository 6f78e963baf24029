"""Transport of bytes: device URLs, serial lines and sockets, Modbus."""
