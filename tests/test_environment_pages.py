"""The tables of options on the pages of the environments name the arguments that there are."""

from __future__ import annotations

import inspect
import re

import gymnasium as gym
import pytest

from rbl_gym.envs.base_station import BaseStationEnv
from rbl_gym.envs.network import PlanarNetworkEnv
from rbl_gym.envs.placement import AnchorPlacementEnv
from rbl_gym.envs.tracking import TrackingEnv
from rbl_gym.wrappers import EstimatePose
from rbl_gym.wrappers.selection import AnchorSelectionEnv
from rbl_gym.wrappers.shared_anchors import SharedAnchorsEnv
from rbl_gym.wrappers.tasks import MobileAnchorsEnv
from tests.helpers import ROOT

PAGES = {
    "tracking": TrackingEnv, "anchor_placement": AnchorPlacementEnv, "wrappers": EstimatePose,
    "mobile_anchors": MobileAnchorsEnv, "anchor_selection": AnchorSelectionEnv,
    "shared_anchors": SharedAnchorsEnv, "base_station": BaseStationEnv,
    "planar_network": PlanarNetworkEnv,
}  # fmt: skip
# Arguments of the environment's makers, and of every environment.
OF_MAKERS = {"anchor_placement": {"scenes", "reward"}}


@pytest.mark.parametrize("page", PAGES)
def test_options_and_their_defaults(page):
    text = (ROOT / "docs" / "environments" / f"{page}.md").read_text()
    pattern = r"^\| (?:option|argument) \| default.*?\n(?=\n)"
    table = re.search(pattern, text, re.MULTILINE | re.DOTALL)
    assert table is not None
    told = {}
    for row in table[0].splitlines()[2:]:
        names, defaults = (re.findall(r"`([^`]+)`", cell) for cell in row.split("|")[1:3])
        told.update(zip(names, defaults, strict=True))
    others = OF_MAKERS.get(page, set())
    found = {
        name: parameter.default
        for name, parameter in inspect.signature(PAGES[page]).parameters.items()
        if name not in {"env", "render_mode"}
    }
    assert set(told) - others == set(found) - others
    for name in set(found) - others:
        stated = eval(told[name])
        if isinstance(stated, float):
            assert found[name] == pytest.approx(stated, rel=1e-2)
        else:
            assert (list(found[name]) if isinstance(stated, list) else found[name]) == stated


def test_every_environment_of_the_registry_has_a_page():
    pages = (ROOT / "docs" / "environments").glob("*.md")
    titles = {page.read_text().partition("\n")[0].removeprefix("# ") for page in pages}
    ids = {name for name in gym.registry if name.startswith("RBL/")}
    assert ids <= titles
