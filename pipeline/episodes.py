"""The stage `episodes`."""

from diffcloud.cli.app import stage

if __name__ == "__main__":
    stage("episodes")
