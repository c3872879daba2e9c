"""`python -m pipeline`: the `diffcloud` command with the code of the current folder, whatever is installed."""

from pipeline.app import main

main()
