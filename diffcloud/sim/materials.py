"""Cloth materials: the data-driven tables of Wang, O'Brien and Ramamoorthi (2011) as ARCSim stores them.

`stretching` [6, 4]: columns are the coefficients (k0: uu, k1: uu-vv coupling, k2: vv, k3: shear). Row 0 holds them at zero
strain, rows 1..5 at the reference strain for stretch directions 0, 22.5, 45, 67.5, 90 degrees from u. ARCSim doubles each
entry, so a constant table entry S gives a stretching stiffness of 2 S [N/m] (force per width per strain).

`bending` [3, 5]: rows are edge directions 0, 45, 90 degrees in material space, columns are curvature bins. An entry k_b
[N·m] enters the hinge energy k_b l² θ² / (8 (a0 + a1)), with edge length l, angle θ and face areas a0 and a1. As in every
hinge model, the bending stiffness per width B that results depends on the mesh. Take a grid of right triangles with side h
and the shape z = (a x² + 2 b x y + c y²)/2. Edges along y turn by (a - b) h, along x by (c - b) h, diagonals by √2 b h, so
the energy per area is

    k_b/2 · [(a - b)²/4 + (c - b)²/4 + b²].

On a cylinder about a grid axis (b = c = 0) this is B a²/2 with B = k_b / 4. A strip with free edges, as in a cantilever
test (ASTM D1388) or a hanging cloth, relaxes to b = c = a/5, and **B = k_b / 5**. A grid with alternating diagonals relaxes
to the same value. The tests check both cases: the energy of a cylinder, and the heavy elastica under refinement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import ConfigError, SceneError, unknown_name
from diffcloud.io.files import read_json

TABLE_ENTRY_TO_STRETCHING = 2.0
"""Stretching stiffness [N/m] per table entry (ARCSim doubles the table when it samples it)."""
TABLE_ENTRY_TO_BENDING = 0.2
"""Bending stiffness per width B [N·m] per table entry, for a strip with free edges."""

_LEAST = 1e-300


@dataclass(frozen=True)
class Material:
    """One fabric, with tables as the module's docstring describes them."""

    name: str
    density: float
    """Mass per area [kg/m²]."""
    stretching: NDArray[np.float64]
    """[6, 4] table [N/m]; entries are half of the stiffness."""
    bending: NDArray[np.float64]
    """[3, 5] table [N·m]."""
    damping: float = 0.0
    """Stiffness-proportional damping [s]."""
    compression: float = 1.0
    """Fraction in [0, 1] of the stretching stiffness that resists compression. Below 1, the cloth model includes wrinkles
    that are finer than the mesh (`terms/wrinkling.py`)."""
    source: str = ""

    def __post_init__(self) -> None:
        for name, table, shape in (("stretching", self.stretching, (6, 4)), ("bending", self.bending, (3, 5))):
            if table.shape != shape or not np.isfinite(table).all():
                raise SceneError(
                    f"Material {self.name!r}: the {name} table must hold {shape[0]} x {shape[1]} finite numbers, "
                    f"got shape {table.shape}."
                )
        if (self.stretching[:, [0, 2]] < 0).any() or (self.bending < 0).any():
            raise SceneError(
                f"Material {self.name!r}: k0 and k2 of the stretching table and the bending table must not be negative; "
                f"the lowest are {self.stretching[:, [0, 2]].min():g} N/m and {self.bending.min():g} N·m."
            )
        if not 0 <= self.compression <= 1:
            raise SceneError(
                f"Material {self.name!r}: compression must be between 0 and 1 (full resistance), got {self.compression}."
            )
        if not self.density > 0 or not self.damping >= 0:
            raise SceneError(
                f"Material {self.name!r}: density must be positive and damping not negative, "
                f"got {self.density} kg/m² and {self.damping} s."
            )

    @property
    def wrinkles(self) -> bool:
        """Whether the material resists compression less than stretching."""
        return self.compression < 1

    def scaled(
        self, *, density: float = 1.0, stretching: float = 1.0, shear: float = 1.0, bending: float = 1.0
    ) -> Material:
        """Return a copy with scaled density and tables. `shear` scales the shear column in addition to `stretching`."""
        return replace(
            self,
            density=self.density * density,
            stretching=self.stretching * stretching * [1.0, 1.0, 1.0, shear],
            bending=self.bending * bending,
        )

    @property
    def resting_stretching_stiffness(self) -> float:
        """Force per width per strain [N/m] of a strip with free sides at zero strain, mean of both directions. This is the
        SI value of a multiplier of 1."""
        k0, k1, k2 = (float(entry) for entry in self.stretching[0, :3])
        coupled = k1**2 / max(k0, _LEAST) + k1**2 / max(k2, _LEAST)
        return TABLE_ENTRY_TO_STRETCHING * 0.5 * (k0 + k2 - coupled)

    @property
    def resting_shear_stiffness(self) -> float:
        """Shear force per width per shear angle at rest [N/m]."""
        return TABLE_ENTRY_TO_STRETCHING * 0.5 * float(self.stretching[0, 3])

    @property
    def resting_shear_part(self) -> float:
        """Ratio of shear stiffness to stretching stiffness at zero strain [-]; 0.5 for an isotropic sheet with ν = 0."""
        return self.resting_shear_stiffness / max(self.resting_stretching_stiffness, _LEAST)

    @property
    def resting_poisson_ratio(self) -> float:
        """Poisson's ratio at zero strain, mean of both directions [-]."""
        k0, k1, k2 = (float(entry) for entry in self.stretching[0, :3])
        return 0.5 * (k1 / max(k0, _LEAST) + k1 / max(k2, _LEAST))

    @property
    def resting_bending_stiffness(self) -> float:
        """Bending stiffness per width B of the flat cloth, mean of the edge directions [N·m]."""
        return TABLE_ENTRY_TO_BENDING * float(self.bending[:, 0].mean())


def isotropic(
    name: str,
    *,
    density: float,
    stretching: float,
    bending: float,
    poisson: float = 0.0,
    shear: float | None = None,
    stiffening: float = 1.0,
    damping: float = 0.0,
    source: str = "",
) -> Material:
    """Build a material from SI values of a data sheet or a simple test. The sheet is isotropic, except for `shear` if
    given.

    Args:
        density: [kg/m²].
        stretching: force per width per strain of a strip with free sides [N/m]. For a solid sheet this is E h.
        bending: bending stiffness per width B [N·m] (ASTM D1388: density · g · (overhang / 2)³). For a solid sheet this is
            E h³/12.
        poisson: Poisson's ratio ν in [0, 1).
        shear: shear force per width per shear angle [N/m]; default that of an isotropic sheet, stretching / (2 (1 + ν)).
            The table's k3 is twice this value: its energy is k3 E01² per area, and the shear angle is 2 E01.
        stiffening: factor on the stretching coefficients at the reference strain of the tables.
        damping: [s].

    Raises:
        SceneError: Poisson's ratio is outside [0, 1), or `Material` rejects a value.
    """
    if not 0 <= poisson < 1:
        raise SceneError(f"Material {name!r}: Poisson's ratio is at least 0 and below 1 here, got {poisson}.")
    plane = stretching / (1 - poisson**2)
    shear = stretching / (2 * (1 + poisson)) if shear is None else shear
    row = np.array([plane, poisson * plane, plane, 2 * shear]) / TABLE_ENTRY_TO_STRETCHING
    table = np.vstack([row, np.tile(row * stiffening, (5, 1))])
    return Material(
        name=name,
        density=density,
        stretching=table,
        bending=np.full((3, 5), bending / TABLE_ENTRY_TO_BENDING),
        damping=damping,
        source=source,
    )


_NOMINAL_SOURCE = (
    "chosen, not measured: soft enough that the whole box [0.1, 10]² of multipliers moves a hand-sized cloth by more "
    "than a depth camera's noise (docs/scenarios.md); most real fabrics lie at its stiff edge. Its shear is half of "
    "an isotropic sheet's, as a knit's is lower"
)
_FOAM_SOURCE = (
    "chosen, not measured: so soft in its plane and so stiff across it that weight, stretching and bending are of similar "
    "magnitude over half a metre, as in a thick sheet of foam; then both multipliers show in the shape (docs/scenarios.md)"
)
_STIFFENING_FOAM_SOURCE = (
    f"{_FOAM_SOURCE}; it stiffens as it stretches and is damped, because a cloth that its own weight draws out to many "
    "times its length slides over a hook in jumps, and 1 % of a parameter then moves it by centimetres"
)
_KES_SOURCE = (
    "order of magnitude from published KES-F / ASTM D1388 ranges for this kind of fabric (e.g. Kawabata, The "
    "Standardization and Analysis of Hand Evaluation, 1980); measure your own before you rely on it"
)

FABRIC_DAMPING = 0.005
"""Default damping of fabrics [s]: chosen, not measured. An elastic vibration of 2 Hz loses a fifth of its amplitude in each
period. Vibrations at the scale of the mesh decay within milliseconds; without damping, no time step would resolve them."""

_PRESETS = {
    material.name: material
    for material in (
        isotropic(
            "soft-knit",
            density=0.2,
            stretching=4.0,
            shear=1.0,
            bending=4e-6,
            stiffening=3.0,
            damping=FABRIC_DAMPING,
            source=_NOMINAL_SOURCE,
        ),
        isotropic(
            "foam",
            density=0.2,
            stretching=2.0,
            shear=0.5,
            bending=0.12,
            stiffening=7.0,
            damping=0.25,
            source=_STIFFENING_FOAM_SOURCE,
        ),
        isotropic(
            "soft-foam",
            density=0.2,
            stretching=1.0,
            shear=0.25,
            bending=0.12,
            stiffening=3.0,
            damping=0.05,
            source=_FOAM_SOURCE,
        ),
        isotropic(
            "jersey-knit",
            density=0.16,
            stretching=60.0,
            shear=15.0,
            bending=3e-6,
            damping=FABRIC_DAMPING,
            source=_KES_SOURCE,
        ),
        isotropic(
            "cotton-shirting",
            density=0.12,
            stretching=800.0,
            shear=30.0,
            bending=8e-6,
            damping=FABRIC_DAMPING,
            source=_KES_SOURCE,
        ),
        isotropic(
            "silk", density=0.06, stretching=700.0, shear=10.0, bending=2e-6, damping=FABRIC_DAMPING, source=_KES_SOURCE
        ),
        isotropic(
            "denim", density=0.4, stretching=2500.0, shear=125.0, bending=8e-5, damping=FABRIC_DAMPING, source=_KES_SOURCE
        ),
        isotropic(
            "paper-towel",
            density=0.045,
            stretching=1500.0,
            shear=350.0,
            bending=4e-5,
            damping=FABRIC_DAMPING,
            source=_KES_SOURCE,
        ),
    )
}


def presets() -> tuple[str, ...]:
    """Names of the built-in materials."""
    return tuple(_PRESETS)


def preset(name: str) -> Material:
    """Return a built-in material by name.

    Raises:
        ConfigError: no such preset; the message lists them.
    """
    if name not in _PRESETS:
        raise ConfigError(unknown_name("material", name, _PRESETS) + " Or give the path of an ARCSim material JSON.")
    return _PRESETS[name]


def read_material(path: Path) -> Material:
    """Read an ARCSim material file: density, stretching [6, 4], bending [3, 5].

    Raises:
        SceneError: the file is missing, has a missing or unknown field, or a table of the wrong shape.
    """
    data = read_json(path, error=SceneError, comments=True)
    expected = {"density", "stretching", "bending"}
    if not isinstance(data, dict) or set(data) != expected:
        got = sorted(data) if isinstance(data, dict) else type(data).__name__
        raise SceneError(f"{path}: a material has the fields {sorted(expected)}, got {got}.")
    try:
        return Material(
            name=Path(path).stem,
            density=float(data["density"]),
            stretching=np.array(data["stretching"], dtype=np.float64),
            bending=np.array(data["bending"], dtype=np.float64),
            source=Path(path).name,
        )
    except (TypeError, ValueError) as error:
        raise SceneError(f"{path}: the tables must be rectangular lists of numbers ({error}).") from error
