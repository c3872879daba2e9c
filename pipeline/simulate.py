"""The stage `simulate`."""

from diffcloud.cli.app import stage

if __name__ == "__main__":
    stage("simulate")
