"""The same cloths in this simulator and in others.

`problem` says what a simulator is given, `problems` has two tests whose answers are known; `ours`, `mujoco`, `newton` and
`explicit` each turn a problem into the motion of its nodes. MuJoCo and Newton are imported when they are run.
"""
