"""`abbe papers`: every printed number of the four papers compared with the computed one."""
