"""The stage `fit`."""

from diffcloud.cli.app import stage

if __name__ == "__main__":
    stage("fit")
