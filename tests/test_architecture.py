"""The architecture: allowed imports, their cost, and the contents of the folders."""

from __future__ import annotations

import ast
import functools
import graphlib
import importlib
import json
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from tests.helpers import ROOT, needs, run_python

FOLDERS = {"rbl_gym": "rbl_gym", "estimators": "rbl_gym.estimators", "wrappers": "rbl_gym.wrappers"}
PLAIN_MODELS = {"bounds", "checks", "geometry", "kernels", "measurements", "motion", "networks"}
# numpy.random's names that are no global state.
GENERATORS = {"Generator", "default_rng", "SeedSequence", "BitGenerator", "PCG64"}


def import_name(file: Path) -> str:
    """The name a file of the three folders is imported under."""
    first, *rest = file.relative_to(ROOT).with_suffix("").parts
    return ".".join([FOLDERS[first], *(part for part in rest if part != "__init__")])


FILES = sorted(file for folder in FOLDERS for file in (ROOT / folder).rglob("*.py"))
MODULES = {import_name(file): file for file in FILES}


@functools.cache
def tree_of(name: str) -> ast.Module:
    """The parsed source of a module."""
    return ast.parse(MODULES[name].read_text(encoding="utf-8"))


@functools.cache
def imports(name: str) -> frozenset[str]:
    """All modules a module imports, also inside functions; `from a import b` as a and a.b."""
    found = set()
    for node in ast.walk(tree_of(name)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.module is not None
            found.add(node.module)
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return frozenset(found)


def within(imported: str, package: str) -> bool:
    return imported == package or imported.startswith(f"{package}.")


def modules_of(package: str) -> list[str]:
    return [name for name in MODULES if within(name, package)]


def pyproject() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


# --- packages ---------------------------------------------------------------------------------


def test_packages_of_pyproject_are_those_of_the_tree():
    tree = [import_name(file) for file in FILES if file.name == "__init__.py"]
    assert sorted(pyproject()["tool"]["setuptools"]["packages"]) == sorted(tree)


def test_every_module_stands_in_a_package():
    for file in FILES:
        assert (file.parent / "__init__.py").is_file(), file


def test_package_directories_of_pyproject_are_the_three_folders():
    mapping = pyproject()["tool"]["setuptools"]["package-dir"]
    assert mapping == {name: folder for folder, name in FOLDERS.items()}


def test_versions_of_pyproject_and_package_agree():
    import rbl_gym

    assert pyproject()["project"]["version"] == rbl_gym.__version__


# --- who imports whom -------------------------------------------------------------------------

ABOVE = ("estimators", "wrappers", "studies", "app")
WORLD = [name for name in MODULES if not any(within(name, f"rbl_gym.{above}") for above in ABOVE)]


def offences(names: Iterable[str], *packages: str) -> list[str]:
    """Which of the modules import something of the packages, and what."""
    return [
        f"{name} imports {imported}"
        for name in names
        for imported in sorted(imports(name))
        if any(within(imported, f"rbl_gym.{package}") for package in packages)
    ]


def test_the_world_imports_nothing_that_stands_above_it():
    assert offences(WORLD, *ABOVE) == []


def test_estimators_import_only_the_plain_models():
    for name in modules_of("rbl_gym.estimators"):
        ours = {m for m in imports(name) if within(m, "rbl_gym")} - {"rbl_gym"}
        assert {m.split(".")[1] for m in ours} <= PLAIN_MODELS | {"estimators"}, name


def test_wrappers_import_neither_studies_nor_the_app():
    assert offences(modules_of("rbl_gym.wrappers"), "studies", "app") == []


def test_studies_do_not_import_the_app():
    assert offences(modules_of("rbl_gym.studies"), "app") == []


def package_of(name: str) -> str:
    """The box a module stands in: a package below `rbl_gym` or `rbl_gym.estimators`, or itself."""
    parts = name.split(".")
    depth = 3 if parts[1:2] == ["estimators"] else 2
    return ".".join(parts[:depth])


def test_packages_import_each_other_without_a_circle():
    boxes = graphlib.TopologicalSorter()
    for name in MODULES:
        for imported in imports(name) & set(MODULES):
            if package_of(name) != package_of(imported) and imported.count("."):
                boxes.add(package_of(name), package_of(imported))
    boxes.prepare()  # raises CycleError, which names the circle


def rows_of_the_table() -> list[list[str]]:
    """The files and folders in each row of the table of packages in docs/development.md."""
    page = (ROOT / "docs" / "development.md").read_text(encoding="utf-8")
    table = page.split("\n| package | content |\n|---|---|\n")[1].split("\n\n")[0]
    rows = [re.findall("`([^`]+)`", line.split("|")[1]) for line in table.splitlines()]
    return [[first, *(str(Path(first).parent / one) for one in more)] for first, *more in rows]


def test_packages_import_only_from_those_above_them_in_the_table():
    rows = rows_of_the_table()
    places = {}
    for name, file in MODULES.items():
        path = file.relative_to(ROOT).as_posix()
        found = [
            row
            for row, parts in enumerate(rows)
            for one in parts
            if path == one or (one.endswith("/") and path.startswith(one))
        ]
        assert len(found) == 1 or name == "rbl_gym", f"docs/development.md, rows of {path}: {found}"
        places[name] = found[0] if found else -1
    below = [
        f"{name} imports {imported}"
        for name in MODULES
        for imported in imports(name) & set(MODULES)
        if places[imported] > places[name] >= 0
    ]
    assert below == []


def test_modules_import_each_other_without_a_circle():
    files = graphlib.TopologicalSorter()
    for name in MODULES:
        for imported in imports(name) & set(MODULES):
            # A name from a package is in one of its modules, or in its `__init__`.
            if not within(name, imported):
                files.add(name, imported)
    files.prepare()


def test_imports_are_absolute_and_by_the_one_name():
    relative = [
        f"{name}, line {node.lineno}"
        for name in MODULES
        for node in ast.walk(tree_of(name))
        if isinstance(node, ast.ImportFrom) and node.level
    ]
    assert relative == []
    bare = [
        f"{name} imports {imported}"
        for name in MODULES
        for imported in imports(name)
        if within(imported, "estimators") or within(imported, "wrappers")
    ]
    assert bare == []


# What a module needs that may be absent: then, so is the module.
BEYOND = {
    "rbl_gym.studies.learning.amortised": "torch",
    "rbl_gym.studies.learning.craft_training": "torch",
    "rbl_gym.studies.learning.set_networks": "torch",
    "rbl_gym.studies.learning.sight_training": "torch",
    "rbl_gym.studies.learning.torch_layouts": "torch",
    "rbl_gym.wrappers.sb3": "stable_baselines3",
    **{name: "numba" for name in MODULES if name.startswith("rbl_gym.kernels.")},
}


@needs("cmaes", "plotly")
def test_every_module_imports_and_none_under_a_second_name():
    absent = {name for name, needs in BEYOND.items() if find_spec(needs) is None} | {
        name for name in MODULES if name.endswith("__main__")
    }
    for name in sorted(set(MODULES) - absent):
        importlib.import_module(name)
    assert not {"estimators", "wrappers"} & set(sys.modules)


# --- what an import costs ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def fresh() -> dict[str, dict[str, Any]]:
    """The modules of a new process and their files, after each of some steps.

    It finds the checkout by its root alone.
    """
    (line,) = run_python("""
import importlib.util, json, sys
told = {}
def tell(step):
    told[step] = {name: getattr(m, "__file__", None) for name, m in sys.modules.items()}
import rbl_gym
tell("import")
import rbl_gym.worlds.scenes
tell("scenes")
import gymnasium
env = gymnasium.make("rbl_gym:RBL/Tracking-v0", render_mode="rgb_array")
env.reset(seed=0)
env.step(0)
tell("step")
env.render()
tell("frame")
import rbl_gym.estimators
tell("estimators")
import rbl_gym.wrappers, rbl_gym.app
tell("all")
folders = ("rbl_gym", "tests", "benchmarks", "examples", "docs")
told["found"] = {name: str(importlib.util.find_spec("rbl_gym." + name)) for name in folders}
print(json.dumps(told))
""")
    return json.loads(line)


def test_import_is_light(fresh):
    heavy = {"matplotlib", "filterpy", "scipy.stats", "rich", "pandas", "torch", "numba"}
    assert not heavy & set(fresh["import"])
    assert "numba" not in fresh["scenes"]


def test_environment_runs_without_the_estimators(fresh):
    assert "rbl_gym.envs.tracking" in fresh["step"]
    heavy = {*(f"rbl_gym.{name}" for name in ABOVE), "filterpy", "matplotlib"}
    assert not heavy & set(fresh["step"])


def test_a_frame_needs_matplotlib_without_pyplot(fresh):
    assert "matplotlib" in fresh["frame"]
    assert "matplotlib.pyplot" not in fresh["frame"]


def test_importing_the_estimators_imports_every_module_that_may_register_a_filter(fresh):
    assert set(modules_of("rbl_gym.estimators")) <= set(fresh["estimators"])


def test_checkout_imports_from_its_root_without_installation(fresh):
    folders = {**FOLDERS, "rbl_gym/app": "rbl_gym.app"}
    for folder, name in folders.items():
        assert fresh["all"][name] == str(ROOT / folder / "__init__.py")
    doa = fresh["all"]["rbl_gym.estimators.locating.doa"]
    assert doa == str(ROOT / "estimators" / "locating" / "doa.py")
    assert not {"estimators", "wrappers"} & set(fresh["all"])


def test_a_checkouts_other_folders_are_no_part_of_the_package(fresh):
    assert set(fresh["found"].values()) == {"None"}


# --- what stands where ------------------------------------------------------------------------


def random_names(tree: ast.Module) -> Iterator[str]:
    """Everything used of numpy.random, however it was imported."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Attribute):
            inner = node.value
            if inner.attr == "random" and getattr(inner.value, "id", "") in ("np", "numpy"):
                yield node.attr
        elif isinstance(node, ast.ImportFrom) and node.module == "numpy.random":
            yield from (alias.name for alias in node.names)


def test_no_global_randomness():
    wrong = {
        name: found for name in MODULES if (found := {*random_names(tree_of(name))} - GENERATORS)
    }
    assert wrong == {}
    assert [name for name in MODULES if "random" in imports(name)] == []
    without_seed = [
        f"{name}, line {node.lineno}"
        for name in MODULES
        for node in ast.walk(tree_of(name))
        if isinstance(node, ast.Call)
        and getattr(node.func, "attr", "") == "default_rng"
        and not node.args
    ]
    assert without_seed == []


def test_no_module_is_longer_than_400_lines():
    lines = {name: file.read_text("utf-8").count("\n") for name, file in MODULES.items()}
    assert {name: count for name, count in lines.items() if count > 400} == {}


def undocumented(node: ast.Module | ast.ClassDef, path: str = "") -> Iterator[str]:
    for child in node.body:
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            if child.name.startswith("_"):
                continue
            if not ast.get_docstring(child):
                yield f"{path}{child.name}"
            if isinstance(child, ast.ClassDef):
                yield from undocumented(child, f"{child.name}.")


def test_everything_public_has_a_docstring():
    missing = [f"{name}: {found}" for name in MODULES for found in undocumented(tree_of(name))]
    assert missing == []
    trees = {name: tree_of(name) for name in MODULES}
    silent = [name for name, tree in trees.items() if tree.body and not ast.get_docstring(tree)]
    assert silent == []


@pytest.mark.parametrize("command", ["make demo", "make test"])
def test_readme_names_the_commands(command):
    target = command.split()[1]
    assert command in (ROOT / "README.md").read_text(encoding="utf-8")
    assert f"\n{target}:" in (ROOT / "Makefile").read_text(encoding="utf-8")
