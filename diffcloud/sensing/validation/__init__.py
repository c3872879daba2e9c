"""Validation of raw episodes."""
