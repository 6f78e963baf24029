"""The web interface: screens, HTTP interface and login. It moves no axis itself; every change needs a permission and is recorded."""
