"""The stage `train`: the networks of the comparison."""

from diffcloud.cli.app import stage
from diffcloud.cli.train import train

if __name__ == "__main__":
    stage(train, "diffcloud.jobs.train")
