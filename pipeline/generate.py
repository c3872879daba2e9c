"""The stage `generate`: the sets that networks are trained on."""

from diffcloud.cli.app import stage
from diffcloud.cli.generate import generate

if __name__ == "__main__":
    stage(generate)
