"""`python -m diffcloud` runs the command with the code of the current folder, even if another version is installed."""

from diffcloud.cli.app import main

main()
