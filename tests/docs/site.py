"""The modules of the site's generator, which MkDocs imports from their folder."""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType

from tests.docs.examples import ROOT


def _module(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / "site" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules.setdefault(name, module)  # as an import would
    spec.loader.exec_module(module)
    return module


reference = _module("reference")
equations = _module("equations")
