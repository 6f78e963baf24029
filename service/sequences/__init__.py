"""Measuring sequences as data: steps are frozen values, checked and drawn before anything moves."""
