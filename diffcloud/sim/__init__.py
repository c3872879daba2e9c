"""The differentiable cloth simulator. Begin reading at `simulate.py`."""
