"""Isotropic material in SI units, as stated in a scenario's YAML file."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from diffcloud.io.schema import Checked, NonNegative, Positive
from diffcloud.sim.materials import FABRIC_DAMPING, Material, isotropic

_SHEET = ("density_kg_m2", "stretching_n_m", "bending_n_m")
_SOLID = ("density_kg_m3", "youngs_modulus_pa", "thickness_m")


class Sheet(Checked):
    """An isotropic material, from tests of a fabric strip or from the properties of a solid sheet such as rubber."""

    density_kg_m2: Positive | None = None
    stretching_n_m: Positive | None = None
    """Force per width per strain of a strip."""
    bending_n_m: Positive | None = None
    """Bending stiffness per width of a strip [N·m]."""
    density_kg_m3: Positive | None = None
    youngs_modulus_pa: Positive | None = None
    thickness_m: Positive | None = None
    poisson: Annotated[float, Field(ge=0, lt=1)] = 0.0
    shear_n_m: Positive | None = None
    """Shear force per width per shear angle. Default: that of an isotropic sheet, stretching / (2 (1 + poisson))."""
    damping_s: NonNegative = FABRIC_DAMPING

    @model_validator(mode="after")
    def _is_one_of_two(self) -> Sheet:
        given = {name for name in (*_SHEET, *_SOLID) if getattr(self, name) is not None}
        if given not in (set(_SHEET), set(_SOLID)):
            got = ", ".join(sorted(given)) or "none of them"
            raise ValueError(f"a material has either {', '.join(_SHEET)} or {', '.join(_SOLID)}; got {got}")
        return self

    def material(self, name: str) -> Material:
        """Return the material with the given name."""
        thickness, modulus = self.thickness_m or 0.0, self.youngs_modulus_pa or 0.0
        return isotropic(
            name,
            density=self.density_kg_m2 or (self.density_kg_m3 or 0.0) * thickness,
            stretching=self.stretching_n_m or modulus * thickness,
            bending=self.bending_n_m or modulus * thickness**3 / 12,
            poisson=self.poisson,
            shear=self.shear_n_m,
            damping=self.damping_s,
            source="the scenario's own numbers",
        )
