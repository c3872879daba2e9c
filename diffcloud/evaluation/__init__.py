"""Comparison of methods under equal conditions, and intervals of the parameters."""
