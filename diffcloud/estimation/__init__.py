"""Fitting simulator parameters to point clouds with the simulator's derivatives."""
