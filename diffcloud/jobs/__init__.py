"""Long work with files: many jobs in several processes, what is finished kept, progress told, Ctrl-C answered.

Commands and stages of the pipeline run what lies here; each parses its options, calls one function, and prints or writes.
"""
