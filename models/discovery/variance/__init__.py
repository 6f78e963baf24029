"""Readings that scatter more than noise: where, when and with which rhythm."""
