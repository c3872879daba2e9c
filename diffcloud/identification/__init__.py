"""From recordings of a cloth to its parameters: what is assumed where nobody says otherwise."""

from diffcloud.identification.protocol import (
    fit_settings,
    found_cloth,
    known_grip,
    with_density,
    with_material_path,
)

__all__ = ["fit_settings", "found_cloth", "known_grip", "with_density", "with_material_path"]
