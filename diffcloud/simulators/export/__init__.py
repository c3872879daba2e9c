"""A fitted cloth for other simulators: `targets` lists them, `cloth` says what of it they can be given, `write` writes
their files, `check` runs these and compares.

Scripts that run an exported cloth need nothing of this package; they lie in `diffcloud.simulators.scripts`.
"""
