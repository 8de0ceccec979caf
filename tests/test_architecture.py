"""Who may import whom, and what every file must keep to."""

import ast
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "cassie_mjx"
SOURCES = sorted(PACKAGE.rglob("*.py")) + sorted((ROOT / "experiments").glob("*.py"))

# The house from the ground up: a package may import its own layer and those below. A new one finds its place here.
LAYERS = (
    {"starting", "gymnasium_id", "configuration", "files"},
    {"robot", "cli", "numpy_policy"},
    {"motion", "control", "reporting"},
    {"physics"},
    {"ppo", "heuristic"},
    {"agents", "envs"},
    {"evaluation"},
    {"training"},
    {"train", "evaluate", "render", "view", "demo", "export", "report"},
)
# What needs NumPy alone, so that a user's simulator does too.
LIGHT = (
    "files",
    "robot.cassie",
    "robot.arrays",
    "robot.rotation",
    "motion.reference",
    "motion.command",
    "control",
    "reporting",
)
# What an extra is for: these alone import what it installs.
VIEWS = {
    "agents/onnx_file.py": "onnx",
    "envs/gymnasium_env.py": "gymnasium",
    "envs/playground_env.py": "playground",
    "evaluation/web.py": "web",
}
# Playground is not among what the tests need.
OWNERS = {"mujoco_playground": ["playground"], **packages_distributions()}
HEAVY = {"jax", "flax", "mujoco", "brax", "optax", "orbax"}


def module_name(path):
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def imports(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def below(name, package):
    return name == package or name.startswith(package + ".")


def layer(package):
    return next(i for i, packages in enumerate(LAYERS) if package in packages)


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=module_name)
def test_imports_go_down(path):
    package = path.relative_to(PACKAGE).with_suffix("").parts[0]
    if package in ("__init__", "numpy_policy"):
        return
    # envs knows no agent; an agent may use what ends an episode.
    found = {name.split(".")[1] for name in imports(path) if name.startswith("cassie_mjx.")} - {package, "cli"}
    assert all(layer(other) <= layer(package) for other in found), found
    assert not (package == "ppo" and found & {"physics", "envs", "robot"}), "the learner never meets an engine"
    name = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
    if name.startswith(LIGHT):
        assert not HEAVY & {each.split(".")[0] for each in imports(path)}


def distributions(paths):
    """What has to be installed for these files, apart from Python and us."""
    tops = {name.split(".")[0] for path in paths for name in imports(path)}
    # Of several distributions that share a package, as mujoco and mujoco-mjx do, the one of its name counts.
    found = {top: OWNERS[top] for top in tops - sys.stdlib_module_names - {"cassie_mjx", "experiments"}}
    return {canonicalize_name(top if top in names else names[0]) for top, names in found.items()}


def test_files_are_read_and_written_with_numpy_alone():
    assert distributions((PACKAGE / "files").glob("*.py")) == {"numpy"}


def named(requirements):
    return {canonicalize_name(Requirement(line).name) for line in requirements}


def test_what_is_imported_is_declared_where_it_is_needed():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    declared, extras = named(project["dependencies"]), project["optional-dependencies"]
    views = {path: named(extras[extra]) for path, extra in VIEWS.items()}
    for path in PACKAGE.rglob("*.py"):
        assert distributions([path]) <= declared | views.get(path.relative_to(PACKAGE).as_posix(), set()), path
    assert declared - distributions(SOURCES) <= {"mujoco-mjx"}


@pytest.mark.parametrize("path", SOURCES, ids=module_name)
def test_files_stay_short(path):
    assert len(path.read_text().splitlines()) <= 400
