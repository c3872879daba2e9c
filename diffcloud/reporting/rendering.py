"""Pages from templates.

Texts are escaped by the templates, whatever an episode is called; data for the scripts are JSON that cannot end or confuse
the script element it stands in.
"""

from __future__ import annotations

from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup


def render(template: str, **told: Any) -> str:
    """The page as HTML text, with all scripts inside: no request leaves it.

    Args:
        template: its file in `templates`.
        told: what the template takes.
    """
    from plotly.offline import get_plotlyjs  # slow to import

    engine = Environment(
        loader=PackageLoader("diffcloud.reporting"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    engine.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    return engine.get_template(template).render(plotly=Markup(get_plotlyjs()), **told)
