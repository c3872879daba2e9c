"""Damaged files of every kind, every command disturbed in its work, and faults while an arm moves.

`kinds` has a good file of every kind and what reads it, `damage` the ways in which it goes bad, `expected.yaml` what may be
taken all the same; `isolated` reads one in a process with limits, `inputs` all of them. `faults` disturbs commands, and
`arm` what a capture needs. All run by `python -m tests.robustness`, a sample of each in the slow tests.
"""
