"""Long-running work on files: parallel jobs that keep finished results, show progress, and handle Ctrl-C.

CLI commands and pipeline stages parse options, call one of these functions, and print or write its result.
"""
