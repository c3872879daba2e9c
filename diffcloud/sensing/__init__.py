"""Recordings of cameras and arm, real and synthetic, and what their clouds need before a fit."""
