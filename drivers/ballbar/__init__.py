"""The telescoping ball-bar on a serial line (docs/protocols/ballbar.md)."""
