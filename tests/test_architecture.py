"""Imports run one way, stages depend on what they import, parameters and their documentation agree."""

from __future__ import annotations

import ast
import importlib
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer
import yaml
from pydantic import BaseModel

ROOT = Path(__file__).parents[1]
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
    "identification": {"mesh", "io", "sim", "scene", "clouds", "estimation"},
    "simulators": {"mesh", "io", "sim", "scene", "arcsim", "estimation"},
    "sensing": {"mesh", "io", "clouds"},
    "hardware": {"mesh", "io", "clouds", "sensing"},
    "live": {"mesh", "io", "clouds", "sensing"},
    "reporting": {"mesh", "io", "sim", "scene", "clouds", "estimation", "regressors", "sensing", "evaluation"},
    "jobs": {
        "mesh",
        "io",
        "sim",
        "scene",
        "arcsim",
        "clouds",
        "estimation",
        "evaluation",
        "identification",
        "regressors",
        "sensing",
        "reporting",
    },
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


SAME_RESULTS = {
    "cli.app",
    "cli.options",
    "jobs.cluster",
    "jobs.ctrl_c",
    "jobs.fork_server",
    "jobs.memory",
    "jobs.scenarios",
}
"""Modules that decide nothing of what a stage writes."""
LEAVES = {*SAME_RESULTS, "jobs.settings", "jobs.pool"}
"""Modules whose own imports decide nothing either: values that a stage reads are its parameters."""


def stage_modules(stage: str) -> dict[str, Path]:
    """The command of a stage, and what it imports of `cli` and `jobs`, by name."""
    found: dict[str, Path] = {}
    todo = {f"pipeline.{stage}": ROOT / "pipeline" / f"{stage}.py"}
    while todo:
        name, path = todo.popitem()
        found[name] = path
        if name in LEAVES:
            continue
        for module in imported(path):
            parts = module.split(".")
            inner = ROOT.joinpath(*parts[:3]).with_suffix(".py")
            if parts[0] == "diffcloud" and parts[1:2] in (["cli"], ["jobs"]) and inner.is_file():
                todo |= {".".join(parts[1:3]): inner} if ".".join(parts[1:3]) not in found else {}
    return found


def needed_packages(stage: str) -> set[str]:
    """Rooms that a stage's command reaches, through whatever those import."""
    modules = stage_modules(stage)
    seen: set[str] = set()
    todo = {"scene"} if "jobs.scenarios" in modules else set[str]()
    for name, path in modules.items():
        todo |= packages(path) & ALLOWED.keys() if name not in LEAVES else set()
    while todo - {"jobs"}:
        package = todo.pop()
        if package == "jobs":
            continue
        seen.add(package)
        todo |= REGISTERED.get(package, set()) - seen
        for path in (ROOT / "diffcloud" / package).rglob("*.py"):
            todo |= (packages(path) & ALLOWED.keys()) - seen
    return seen


def stages() -> dict:
    return yaml.safe_load((ROOT / "dvc.yaml").read_text(encoding="utf-8"))["stages"]


@pytest.mark.parametrize("stage", ["synthesize", "preprocess", "generate", "fit", "train", "evaluate", "report"])
def test_stage_dependencies_are_the_imports(stage):
    listed = {Path(dep).name for dep in stages()[stage]["deps"] if dep.startswith("diffcloud/") and not dep.endswith(".py")}
    assert listed == needed_packages(stage)
    decide = {f"diffcloud/{name.replace('.', '/')}.py" for name in stage_modules(stage) if name not in SAME_RESULTS}
    decide = {name for name in decide if not name.startswith("diffcloud/pipeline/")}
    files = {dep for dep in stages()[stage]["deps"] if dep.startswith(("diffcloud/cli/", "diffcloud/jobs/"))}
    assert files == decide


def test_stage_parameters_are_sections_of_the_configuration():
    from diffcloud.estimation.settings import FitSettings, LikelihoodSolver
    from diffcloud.jobs.settings import Config
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
        if section is FitSettings:
            assert list(values["solver"]) == list(LikelihoodSolver.model_fields)

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

    from diffcloud.jobs.settings import load_config

    path = tmp_path / "params.yaml"
    for name in leaves(yaml.safe_load((ROOT / "params.yaml").read_text(encoding="utf-8"))):
        shutil.copy(ROOT / "params.yaml", path)
        apply_overrides(path, [f"{name}=null"])
    changes = ["fit.seed=3", "fit.fixed.density=1.2", "fit.bounds.stretching=[0.5,2]", "fit.solver.starts=2"]
    shutil.copy(ROOT / "params.yaml", path)
    apply_overrides(path, [*changes, "preprocess.raw.origin_m=[1,2,3]"])
    config = load_config(path)
    assert (config.fit.seed, config.fit.fixed, config.fit.bounds) == (3, {"density": 1.2}, {"stretching": (0.5, 2.0)})
    assert (config.fit.solver.starts, config.preprocess.raw.origin_m) == (2, (1.0, 2.0, 3.0))


def test_every_stage_command_exists():
    check_commands(stages())


def test_stages_run_the_code_of_the_checkout():
    for name, stage in stages().items():
        assert stage["cmd"].startswith(f"python -m pipeline.{name} ")
        assert "    stage(" in (ROOT / "pipeline" / f"{name}.py").read_text(encoding="utf-8")


def check_commands(stages: dict) -> None:
    """What stages run are commands and options of this package."""
    from typer.main import get_command

    from diffcloud.cli.app import app

    for stage in stages.values():
        words = stage["cmd"].split()
        if words[:2] == ["python", "-m"]:
            module = importlib.import_module(words[2])
            alone = typer.Typer()
            name = words[2].removeprefix("pipeline.")
            alone.command()(getattr(module, name, None) or module.generate)
            command = get_command(alone)
        else:
            assert words[0] == "diffcloud"
            command = get_command(app).get_command(None, words[1])
        options = {option for parameter in command.params for option in parameter.opts}
        assert {word for word in words if word.startswith("--")} <= options


def test_public_lists_name_what_exists():
    for package in ALLOWED:
        module = importlib.import_module(f"diffcloud.{package}")
        for name in getattr(module, "__all__", []):
            assert hasattr(module, name), f"{package}.{name}"


def test_dvc_does_not_phone_home():
    config = (ROOT / ".dvc" / "config").read_text(encoding="utf-8")
    assert "analytics = false" in config
    assert "check_update = false" in config


def test_seven_commands_with_few_options():
    from typer.main import get_command

    from diffcloud.cli.app import app

    def options(command) -> int:
        own = sum(one.param_type_name == "option" for one in command.params)
        return own + sum(
            options(command.get_command(None, name)) for name in getattr(command, "list_commands", lambda _: [])(None)
        )

    top = get_command(app)
    assert len(top.list_commands(None)) == 7
    assert options(top) <= 138


def test_the_light_settings_of_networks_take_what_the_networks_take():
    """They repeat the choices, because the networks' own module imports torch."""
    from typing import get_args

    from diffcloud.jobs.network_settings import TrainSettings
    from diffcloud.regressors.settings import Loss, Profile, Target

    fields = TrainSettings.model_fields
    assert fields["profile"].annotation == Profile
    for name, choices in (("loss", Loss), ("target", Target)):
        assert get_args(fields[name].annotation) == (choices, type(None))
