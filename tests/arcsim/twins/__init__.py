"""Plain twins of the kernels of ARCSim's contact, written like the equations."""
