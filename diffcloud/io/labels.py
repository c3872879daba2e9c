"""Labels of a recording (`KEY=VALUE`), which are stored in episode.json and in the meta of an imported episode."""

from __future__ import annotations

from collections.abc import Iterable

from pydantic import ValidationError

from diffcloud.errors import ConfigError
from diffcloud.io.raw_episodes import EpisodeFile
from diffcloud.io.schema import explain

_KNOWN = frozenset({"scenario", "fabric", "category"})
"""Fields of episode.json that are labels. Evaluation tables and pipeline stages use them."""
_TAKEN = (frozenset(EpisodeFile.model_fields) - _KNOWN) | {
    "trajectory", "viewpoints", "pinholes", "cut_planes", "clocks", "scale_sigma", "pose_sigmas", "quality", "agreement",
    "set_up", "rest_s", "predictions", "noise_free", "category_assumed",
}  # fmt: skip
"""Reserved keys. Commands write them and fits read them, so a label of this name would be misinterpreted."""


def read_labels(items: Iterable[str]) -> dict[str, str]:
    """Parse labels: ["scenario=lift", ...] becomes {"scenario": "lift"}.

    Raises:
        ConfigError: an item is not KEY=VALUE, a key occurs twice or is reserved, or a value is invalid for its key.
    """
    labels: dict[str, str] = {}
    for item in items:
        key, _, value = (part.strip() for part in item.partition("="))
        if not (key and value) or key in labels:
            raise ConfigError(
                f"--label takes KEY=VALUE, each key once, got {item!r}. Try --label scenario=lift --label fabric=tan."
            )
        if key in _TAKEN:
            raise ConfigError(
                f"--label {item}: episodes keep a fact under the name {key!r}. Allowed are {', '.join(sorted(_KNOWN))} and "
                "names of your own. Try another name."
            )
        labels[key] = value
    try:
        EpisodeFile.model_validate({"schema_version": 1, "cameras": ["any"], **labels})
    except ValidationError as error:
        raise explain("--label", error, ConfigError) from error
    return labels
