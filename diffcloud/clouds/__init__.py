"""Point clouds: sampling from meshes, training clouds, nearest neighbours, losses."""

from diffcloud.clouds.augmentation import Augmentation, CloudMaker
from diffcloud.clouds.losses import chamfer, one_sided_chamfer
from diffcloud.clouds.neighbours import NeighbourIndex, brute_force_neighbours
from diffcloud.clouds.sampling import SurfaceSampler

__all__ = [
    "Augmentation",
    "CloudMaker",
    "NeighbourIndex",
    "SurfaceSampler",
    "brute_force_neighbours",
    "chamfer",
    "one_sided_chamfer",
]
