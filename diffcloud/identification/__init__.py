"""Default assumptions for estimating the parameters of a cloth from recordings."""

from diffcloud.identification.hanging import HANG_FIELDS, prepared
from diffcloud.identification.protocol import (
    fit_settings,
    found_cloth,
    found_layout,
    known_grip,
    with_density,
    with_material_path,
)

__all__ = [
    "HANG_FIELDS",
    "fit_settings",
    "found_cloth",
    "found_layout",
    "known_grip",
    "prepared",
    "with_density",
    "with_material_path",
]
