"""Twins of kernels: the same equations once more, plain, slow and unbatched, to compare the kernels with."""
