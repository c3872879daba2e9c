"""Long-running work on files: parallel jobs that keep finished results, show progress, and handle Ctrl-C.

CLI commands and pipeline stages use these functions. They parse options, call one function, and print or write its
result.
"""
