"""The decorator of kernels and their folder, which the whole package shares: see `diffcloud.compiled`."""

from diffcloud.compiled import UNCOMPILED, cache_folder, kernel

__all__ = ["UNCOMPILED", "cache_folder", "kernel"]
