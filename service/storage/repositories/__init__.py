"""Repositories, in files of the same names as their records in `abbe.service.domain`."""
