"""Default assumptions for estimating the parameters of a cloth from recordings."""

from diffcloud.identification.protocol import (
    fit_settings,
    found_cloth,
    known_grip,
    with_density,
    with_material_path,
)

__all__ = ["fit_settings", "found_cloth", "known_grip", "with_density", "with_material_path"]
