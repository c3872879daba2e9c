"""Default assumptions for estimating the parameters of a cloth from recordings."""

from diffcloud.identification.hanging import prepared
from diffcloud.identification.protocol import (
    fit_settings,
    found_cloth,
    found_layout,
    known_grip,
    missing_fields,
    starts_hanging,
    with_density,
)

__all__ = [
    "fit_settings",
    "found_cloth",
    "found_layout",
    "known_grip",
    "missing_fields",
    "prepared",
    "starts_hanging",
    "with_density",
]
