"""The stage `report`."""

from diffcloud.cli.app import stage

if __name__ == "__main__":
    stage("report")
