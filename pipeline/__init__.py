"""The stages of `dvc repro`, one program each: `python -m pipeline.fit`. Each runs the command of its name."""
