"""Simulate the same cloth in DiffCloud's simulator and in others, to compare them.

`problem` defines the input of a simulator, and `problems` two tests with analytical solutions. `ours`, `mujoco`,
`newton` and `explicit` simulate a problem and return the motion of its nodes. MuJoCo and Newton are imported only when
they are used.
"""
