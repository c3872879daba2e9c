"""The same cloths in this simulator and in others.

`problem` says what a simulator is given, `problems` has the motions and the tests whose answers are known; `ours`,
`mujoco`, `newton` and `explicit` each turn a problem into the motion of its nodes; `study` compares them. MuJoCo and
Newton are imported when they are run.
"""
