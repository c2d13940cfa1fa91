"""The public names: listed in the reference, documented, and used by a test or an example."""

from __future__ import annotations

import importlib
import inspect
import re
from pathlib import Path

from tests.helpers import ROOT

FOLDERS = {"rbl_gym": "rbl_gym", "estimators": "rbl_gym.estimators", "wrappers": "rbl_gym.wrappers"}
# The pictures are drawn by the environments: `render_mode`.
OWN = {"rbl_gym.rendering"}
PAGES = [(ROOT / "README.md"), *(ROOT / "docs").rglob("*.md")]
LISTED = {
    name for page in PAGES for name in re.findall(r"^::: (\S+)", page.read_text(), re.MULTILINE)
}


def public_modules():
    """Modules that say what of them is public."""
    for folder, package in FOLDERS.items():
        for path in sorted((ROOT / folder).rglob("*.py")):
            handed_on = path.name == "__init__.py" and len(path.relative_to(ROOT).parts) > 2
            short_name = path.parent == ROOT / "rbl_gym" and path.name in (
                "ranging.py",
                "bodies.py",
            )
            if "\n__all__ = " in path.read_text() and not (handed_on or short_name):
                parts = path.relative_to(ROOT / folder).with_suffix("").parts
                yield ".".join([package, *(part for part in parts if part != "__init__")])


MODULES = sorted(set(public_modules()) - OWN)


def used_words():
    """Words of all tests, examples and blocks of code on pages."""
    here = Path(__file__)
    code = [
        path.read_text()
        for folder in ("tests", "examples")
        for path in (ROOT / folder).rglob("*.py")
        if path != here
    ]
    for page in PAGES:
        code += re.findall(r"```python(.*?)```", page.read_text(), re.DOTALL)
    return set(re.findall(r"\w+", "\n".join(code)))


WORDS = used_words()


def imported(name):
    """The module, or None where an extra that it stands on is not installed."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if str(error.name).startswith("rbl_gym"):
            raise
        return None


def public_names():
    """Modules and their public names: (name of the module, public name, its value)."""
    for name in MODULES:
        if module := imported(name):
            assert module.__all__, f"{name} without public names needs no __all__"
            yield from ((name, public, getattr(module, public)) for public in module.__all__)


def test_public_names_are_documented_listed_and_used():
    for name, public, value in public_names():
        if callable(value):
            assert inspect.getdoc(value), f"{name}.{public} has no docstring"
        assert public in WORDS, f"no test and no example uses {name}.{public}"
        whole = name in LISTED
        assert whole or f"{name}.{public}" in LISTED, f"{name}.{public} is in no reference"


def test_the_reference_lists_public_names_only():
    for name in LISTED:
        owner, _, public = name.rpartition(".")
        if name not in MODULES and (module := imported(owner)):
            # Environments are registered by id: their modules name nothing else.
            assert public in getattr(module, "__all__", [public]), name
            assert hasattr(module, public), name


def parameters_section(doc):
    found = re.search(
        r"^Parameters\n-+\n(.*?)(?=^\S[^\n]*\n-+\n|\Z)", doc, re.MULTILINE | re.DOTALL
    )
    return found.group(1) if found else ""


def test_docstrings_name_the_arguments_that_there_are():
    for name, public, value in public_names():
        doc = inspect.getdoc(value) or ""
        if not callable(value) or re.search(r"Arguments\s+as", doc):
            continue
        try:
            arguments = set(inspect.signature(value).parameters) - {"self", "args", "kwargs"}
        except ValueError:  # of a type written in C
            continue
        heads = re.findall(r"^(\S.*)$", parameters_section(doc), re.MULTILINE)
        told = {word.split(":")[0].strip(" *`") for head in heads for word in head.split(",")}
        assert told <= arguments, f"{name}.{public} has no {told - arguments}"
        if told or (inspect.isfunction(value) and len(arguments) > 3):
            silent = {word for word in arguments if not re.search(rf"\b{word}\b", doc)}
            assert not silent, f"{name}.{public} does not say what {silent} is"
