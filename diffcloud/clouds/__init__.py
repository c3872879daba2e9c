"""Point clouds: sampling from meshes, training clouds, nearest neighbours, and losses."""

from diffcloud.clouds.augmentation import Augmentation, CloudMaker
from diffcloud.clouds.background import Background
from diffcloud.clouds.losses import chamfer, one_sided_chamfer
from diffcloud.clouds.neighbours import NeighbourIndex
from diffcloud.clouds.sampling import SurfaceSampler

__all__ = [
    "Augmentation",
    "Background",
    "CloudMaker",
    "NeighbourIndex",
    "SurfaceSampler",
    "chamfer",
    "one_sided_chamfer",
]
