"""How bytes travel: device URLs, serial lines and sockets, Modbus."""
