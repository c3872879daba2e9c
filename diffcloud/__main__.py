"""`python -m diffcloud`: the command with the code of the current folder, whatever is installed."""

from diffcloud.cli.app import main

main()
