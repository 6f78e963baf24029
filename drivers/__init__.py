"""Asynchronous communication with instruments and controllers. Physics and measuring jobs are not part of a driver."""
