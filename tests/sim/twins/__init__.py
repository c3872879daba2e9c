"""Plain torch twins of the kernels, written like the equations: their specification."""
