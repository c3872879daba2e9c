"""The stage `preprocess`: clean synthetic recordings, and those in raw/."""

from diffcloud.cli.app import stage
from diffcloud.cli.preprocess import preprocess

if __name__ == "__main__":
    stage(preprocess, "diffcloud.jobs.preprocess")
