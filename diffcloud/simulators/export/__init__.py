"""Export a fitted cloth to other simulators.

`targets` lists the simulators, `cloth` converts the fit to a problem that they can simulate, `write` writes their
files, and `check` runs these and compares. The exported scripts do not need this package; they are in
`diffcloud.simulators.scripts`.
"""
