"""Recordings of cameras and arm, real and synthetic, and the processing of their clouds before a fit."""
