"""Imports run one way, stages depend on what they import, parameters and their documentation agree."""

from __future__ import annotations

import ast
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from pydantic import BaseModel

ROOT = Path(__file__).parents[1]
CLI = ROOT / "diffcloud" / "cli"
ALLOWED = {
    "mesh": set(),
    "io": {"mesh"},
    "sim": {"mesh", "io"},
    "scene": {"mesh", "io", "sim"},
    "arcsim": {"mesh", "io", "sim", "scene"},
    "clouds": {"mesh", "io"},
    "datasets": {"mesh", "io", "sim", "scene", "clouds"},
    "estimation": {"mesh", "io", "sim", "scene", "clouds"},
    "regressors": {"mesh", "io", "clouds"},
    "evaluation": {"mesh", "io", "sim", "scene", "clouds", "estimation"},
    "identification": {"mesh", "io", "sim", "scene", "estimation"},
    "simulators": {"mesh", "io", "sim", "scene", "arcsim", "estimation"},
    "sensing": {"mesh", "io", "clouds"},
    "hardware": {"mesh", "io", "clouds", "sensing"},
    "live": {"mesh", "io", "clouds", "sensing"},
    "report": {"mesh", "io", "sim", "scene", "clouds", "estimation", "regressors", "sensing", "evaluation"},
}
"""Sub-package -> the sub-packages it may import; all may import errors."""
REGISTERED = {"sim": {"arcsim"}, "scene": {"arcsim"}}
"""Sub-package -> those whose modules its registry names (`sim.integrators`, `scene.registry`); imported on first use."""


def imported(path: Path) -> set[str]:
    """Modules that a file imports, dotted."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def packages(path: Path) -> set[str]:
    """Sub-packages of diffcloud that a file imports."""
    return {name.split(".")[1] for name in imported(path) if name.startswith("diffcloud.") and name.count(".") >= 1}


@pytest.mark.parametrize("package", ALLOWED)
def test_imports_run_one_way(package):
    for path in (ROOT / "diffcloud" / package).rglob("*.py"):
        extra = (packages(path) & ALLOWED.keys()) - ALLOWED[package] - {package}
        assert not extra, f"{path.relative_to(ROOT)} imports {sorted(extra)}"
        assert "cli" not in packages(path), path
        assert not {name.split(".")[0] for name in imported(path)} & {"pipeline", "studies"}, path


def test_every_package_is_in_the_table():
    found = {path.name for path in (ROOT / "diffcloud").iterdir() if (path / "__init__.py").is_file()}
    assert found == {*ALLOWED, "cli"}


def test_meshes_and_kernels_know_no_torch():
    sim = ROOT / "diffcloud" / "sim"
    kernels = [sim / name for name in ("compiled", "contact", "implicit", "terms")]
    for folder in (ROOT / "diffcloud" / "mesh", ROOT / "diffcloud" / "arcsim", *kernels):
        for path in folder.rglob("*.py"):
            assert not any(name.split(".")[0] == "torch" for name in imported(path)), path


SAME_RESULTS = {"console", "ctrl_c", "lazy", "predict", "scenario_options"}
"""Modules of `cli` that decide nothing of what a stage of the default parameters writes."""


def pipeline_modules(stage: str) -> set[str]:
    """What a stage's command imports, itself or by the comparison."""
    own = imported(CLI / f"{stage}.py")
    return own | imported(CLI / "comparison.py") if "diffcloud.cli.comparison" in own else own


def needed_packages(stage: str) -> set[str]:
    """Sub-packages a stage's command reaches, through whatever those import."""
    seen: set[str] = set()
    todo = packages(CLI / f"{stage}.py") & ALLOWED.keys()
    if "diffcloud.cli.comparison" in pipeline_modules(stage):
        todo |= packages(CLI / "comparison.py") & ALLOWED.keys()
    if "scenario_options" in (CLI / f"{stage}.py").read_text(encoding="utf-8"):
        todo |= {"scene"}
    while todo:
        package = todo.pop()
        seen.add(package)
        todo |= REGISTERED.get(package, set()) - seen
        for path in (ROOT / "diffcloud" / package).rglob("*.py"):
            todo |= (packages(path) & ALLOWED.keys()) - seen
    return seen


def stages() -> dict:
    return yaml.safe_load((ROOT / "dvc.yaml").read_text(encoding="utf-8"))["stages"]


@pytest.mark.parametrize("stage", ["episodes", "preprocess", "simulate", "fit", "train", "evaluate", "report"])
def test_stage_dependencies_are_the_imports(stage):
    listed = {Path(dep).name for dep in stages()[stage]["deps"] if dep.startswith("diffcloud/") and not dep.endswith(".py")}
    assert listed == needed_packages(stage)
    imports = {name.split(".")[2] for name in pipeline_modules(stage) if name.startswith("diffcloud.cli.")}
    modules = {stage, *imports} - SAME_RESULTS
    assert {f"diffcloud/cli/{name}.py" for name in modules} <= set(stages()[stage]["deps"])


def test_stage_parameters_are_sections_of_the_configuration():
    from diffcloud.cli.config import Config
    from diffcloud.sim.properties import PARAMETERS

    written = yaml.safe_load((ROOT / "params.yaml").read_text(encoding="utf-8"))
    used = {name.partition(".")[0] for stage in stages().values() for name in stage.get("params", [])}
    assert used == set(Config.model_fields)
    Config.model_validate(written)

    def compare(section: type[BaseModel], values: dict, name: str) -> None:
        """Every key is stated, so that `dvc exp run -S` finds it."""
        assert list(values) == list(section.model_fields), name
        for key, field in section.model_fields.items():
            if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
                compare(field.annotation, values[key], f"{name}{key}.")

    compare(Config, written, "")
    for mapping in ("bounds", "fixed"):
        assert list(written["fit"][mapping]) == list(PARAMETERS)


def leaves(values: dict, above: str = "") -> Iterator[str]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{above}{name}.")
        else:
            yield f"{above}{name}"


def test_every_setting_can_be_set_in_an_experiment(tmp_path):
    """By `dvc exp run -S`, which takes keys that the file states; and what is set is what a stage reads."""
    from dvc.utils.hydra import apply_overrides

    from diffcloud.cli.config import load_config

    path = tmp_path / "params.yaml"
    for name in leaves(yaml.safe_load((ROOT / "params.yaml").read_text(encoding="utf-8"))):
        shutil.copy(ROOT / "params.yaml", path)
        apply_overrides(path, [f"{name}=null"])
    changes = ["fit.seed=3", "fit.fixed.mass=1.2", "fit.bounds.stretch=[0.5,2]", "fit.solver=cma_es"]
    shutil.copy(ROOT / "params.yaml", path)
    apply_overrides(path, [*changes, "fit.simulations=50", "preprocess.raw.origin_m=[1,2,3]"])
    config = load_config(path)
    assert (config.fit.seed, config.fit.fixed, config.fit.bounds) == (3, {"mass": 1.2}, {"stretch": (0.5, 2.0)})
    assert (config.fit.solver, config.fit.simulations, config.preprocess.raw.origin_m) == ("cma_es", 50, (1.0, 2.0, 3.0))


def test_every_stage_command_exists():
    check_commands(stages())


def test_stages_run_the_code_of_the_checkout():
    for name, stage in stages().items():
        assert stage["cmd"].startswith(f"python -m pipeline.{name} ")
        assert f'stage("{name}")' in (ROOT / "pipeline" / f"{name}.py").read_text(encoding="utf-8")


def check_commands(stages: dict) -> None:
    """What stages run are commands and options of this package."""
    from typer.main import get_command

    from diffcloud.cli.app import app

    commands = get_command(app).commands
    for stage in stages.values():
        words = stage["cmd"].removeprefix("python -m pipeline.").removeprefix("diffcloud ").split()
        assert words[0] in commands
        options = {option for parameter in commands[words[0]].params for option in parameter.opts}
        assert {word for word in words if word.startswith("--")} <= options


def test_public_lists_name_what_exists():
    import importlib

    for package in ALLOWED:
        module = importlib.import_module(f"diffcloud.{package}")
        for name in getattr(module, "__all__", []):
            assert hasattr(module, name), f"{package}.{name}"


def test_dvc_does_not_phone_home():
    config = (ROOT / ".dvc" / "config").read_text(encoding="utf-8")
    assert "analytics = false" in config
    assert "check_update = false" in config
