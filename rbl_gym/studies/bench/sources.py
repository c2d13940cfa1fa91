"""Find the source files of a filter: its module, and the modules beside it that it imports."""

from __future__ import annotations

import ast
import functools
import hashlib
import inspect
import sys
from collections.abc import Iterator, Sequence
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path

from rbl_gym import estimators
from rbl_gym.estimators.filter import factory_of


def source_of(name: str) -> str:
    """Return the source of a filter: a package and its version, or the digest of its files."""
    factory = factory_of(name)
    while isinstance(factory, functools.partial):
        factory = factory.func
    home = name.partition(":")[0] if ":" in name else factory.__module__
    if home.startswith("rbl_gym."):
        return "rbl-gym"
    for entry in entry_points(group=estimators.ENTRY_POINT_GROUP):
        if entry.name == name:
            return f"{entry.dist.name} {entry.dist.version}" if entry.dist else entry.value
    module = sys.modules.get(home) or import_module(home)
    file = inspect.getsourcefile(module)
    return digest(_files(home, Path(file))) if file else name


def digest(files: Sequence[Path]) -> str:
    """Return sixteen hexadecimal digits that identify the contents of files."""
    found = hashlib.sha256()
    for file in sorted(files, key=lambda file: (file.parent.name, file.name)):
        found.update(file.read_bytes())
    return found.hexdigest()[:16]


def _files(module: str, file: Path) -> list[Path]:
    """Return the file of a module and those that it imports from its own folder or package.

    The imports are read from the text: all processes then find the same files, whatever they have
    loaded. Installed modules and this package have versions of their own.
    """
    package = file.name == "__init__.py"
    root = file.parents[module.count(".") + package]
    if {"site-packages", "dist-packages"} & {*root.parts}:
        return [file]
    # The package of every file, which relative imports start from.
    found = {file: module if package else module.rpartition(".")[0]}
    names = [module, *_imports(file, found[file])]
    while names:
        name = names.pop()
        inside = name.rpartition(".")[0]
        stem = root.joinpath(*name.split("."))
        for path, at in ((stem / "__init__.py", name), (stem.parent / f"{stem.name}.py", inside)):
            if path not in found and path.is_file() and name.partition(".")[0] != "rbl_gym":
                found[path] = at
                names += _imports(path, at)
        # Importing a.b runs the file of a.
        names += filter(None, [inside])
    return list(found)


def _imports(file: Path, package: str) -> Iterator[str]:
    """Yield the names in the imports of a file; some are modules, some are parts of modules."""
    try:
        tree = ast.parse(file.read_bytes())
    except (SyntaxError, ValueError):
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".") if package and node.level else []
            base = [*above[: len(above) + 1 - node.level], *filter(None, [node.module])]
            yield from (".".join([*base, alias.name]) for alias in node.names)
