"""The paper's MLP: a PointNet without its transforms (paper, section IV-B; Qi et al. 2017, "PointNet"). shared 64, 64,
64, 128, 1024 -> maximum over the points -> 512 -> 256 -> dropout -> outputs"""

from __future__ import annotations

from torch import Tensor, nn

from diffcloud.regressors.layers import Head, highest, shared_layers

WIDTHS = (64, 64, 64, 128, 1024)


class MLP(nn.Module):
    """Network from the points of one frame to outputs."""

    def __init__(self, outputs: int, *, dropout: float = 0.3) -> None:
        super().__init__()
        self.points = shared_layers(3, WIDTHS)
        self.head = Head(WIDTHS[-1], outputs, dropout=(0.0, dropout))

    def forward(self, clouds: Tensor) -> Tensor:
        """Map clouds [B, T, P, 3] to [B, outputs]. The points of all frames are one set."""
        outputs: Tensor = self.head(highest(self.points(clouds.flatten(1, 2))))
        return outputs
