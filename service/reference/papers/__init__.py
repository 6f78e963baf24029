"""Printed numbers of the four papers, their computation, and the papers' pictures."""
