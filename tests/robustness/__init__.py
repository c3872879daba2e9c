"""Damaged files of every kind, and every command disturbed in its work.

`kinds` has a good file of every kind and what reads it, `damage` the ways in which it goes bad, `expected.yaml` what may be
taken all the same; `isolated` reads one in a process with limits, `inputs` all of them. `faults` disturbs commands. Both
run by `python -m tests.robustness`, a sample of both in the slow tests.
"""
