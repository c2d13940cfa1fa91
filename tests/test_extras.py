"""A missing library is reported in one form, with the command that installs it."""

from __future__ import annotations

import ast
import tomllib

import numpy as np
import pytest

from rbl_gym import placement
from rbl_gym.extras import MissingExtraError, require
from rbl_gym.placement import mounting, search
from rbl_gym.placement.plans.reading import read_drawing
from rbl_gym.recordings import bags
from rbl_gym.worlds import scenes
from tests.helpers import ROOT

TASK = placement.PlacementTask(scenes.get("uwb_room"), 4)
CONTEXT = placement.Context(np.ones(3), np.ones(3), np.zeros((0, 6)))
FILES = sorted(
    path
    for folder in ("rbl_gym", "estimators", "wrappers")
    for path in (ROOT / folder).rglob("*.py")
)


def calls():
    """The first two arguments of every call of `require` with an extra."""
    for path in FILES:
        text = path.read_text(encoding="utf-8")
        if "rbl_gym.extras" in text:
            for node in ast.walk(ast.parse(text)):
                if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "require":
                    yield [getattr(value, "value", None) for value in node.args[:2]]


def test_every_extra_that_a_message_names_exists():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"][
        "optional-dependencies"
    ]
    named = list(calls())
    assert len(named) > 10
    assert {extra for _, extra in named} <= set(extras)


def test_only_one_function_writes_the_command_of_an_extra():
    writers = [
        path.name for path in FILES if "pip install 'rbl-gym[" in path.read_text(encoding="utf-8")
    ]
    assert writers == ["extras.py"]


@pytest.mark.parametrize(
    ("use", "message"),
    [
        (
            lambda path: bags.list_topics(path / "log.bag"),
            "reading bags needs the extra bags: pip install 'rbl-gym[bags]'",
        ),
        (
            lambda path: read_drawing(str(path / "plan.dxf")),
            "a drawing (.dxf) needs the extra placement: pip install 'rbl-gym[placement]'",
        ),
        (
            lambda _: mounting.shapely_module(),
            "a building file with [[mounts]] needs the extra placement: pip install "
            "'rbl-gym[placement]'",
        ),
        (
            lambda _: search.cma_es(TASK, CONTEXT, np.random.default_rng(1)),
            "the reference cma-es needs the extra placement: pip install 'rbl-gym[placement]'",
        ),
        (
            lambda _: require("ray", "parallel", "the backend ray", also="ray", instead="wait"),
            "the backend ray needs the extra parallel: pip install 'rbl-gym[parallel]' ray, or "
            "wait",
        ),
    ],
)  # fmt: skip
def test_a_missing_library_is_reported_with_the_command(use, message, monkeypatch, tmp_path):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError) as caught:
        use(tmp_path)
    assert str(caught.value) == message
