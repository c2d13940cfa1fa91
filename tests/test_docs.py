"""The pages: their Python blocks run, their commands exist, all pages can be reached."""

from __future__ import annotations

import importlib.util
import re
import shlex
import sys
import warnings
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import rbl_gym
from rbl_gym.app.cli import _parser
from rbl_gym.estimators import filter as belief
from rbl_gym.measurements import ranging
from rbl_gym.studies.learning import policies
from rbl_gym.studies.learning.deep_sets import DeepSets
from rbl_gym.studies.learning.set_policies import SET_KINDS, SetPolicy
from rbl_gym.studies.replay import causes
from tests.helpers import ROOT, needs

# Its blocks are files of a package: tests/test_your_estimator.py.
OF_ITS_OWN = "your_estimator"
PAGES = sorted((ROOT / "docs").rglob("*.md"))
# Learners: blocks that import them are compiled only if they are not installed; else they train
# for one rollout.
FOREIGN = re.compile(r"^from (torchrl|ray|stable_baselines3|sb3_contrib)\b", re.MULTILINE)
SHORT = {
    r"\.learn\([\d_]+\)": ".learn(1)",
    r"total_frames=[\d_]+": "total_frames=1024",
    r"range\(8\)": "range(1)",
    "num_env_runners=2": "num_env_runners=0",
}


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(), re.DOTALL)


def write_files_that_pages_read(folder: Path) -> None:
    """A recording of a body at rest, a policy, the examples."""
    (folder / "examples").symlink_to(ROOT / "examples")
    anchors = np.array([[0, 0, 0], [8, 0, 2], [0, 6, 2], [8, 6, 0], [4, 3, 3.0]])
    tags = np.array([[0.4, 0, 0], [-0.4, 0.3, 0], [0, -0.3, 0.3], [0, 0, -0.4]])
    noise, rng = ranging.RangeNoise(0.05), np.random.default_rng(0)
    lines = {"anchors": ["anchor,x,y,z"], "tags": ["tag,x,y,z"], "ranges": ["t,anchor,tag,range"],
             "truth": ["t,x,y,z,qw,qx,qy,qz"]}  # fmt: skip
    for name, places in (("anchors", anchors), ("tags", tags)):
        lines[name] += [f"{i},{x},{y},{z}" for i, (x, y, z) in enumerate(places.tolist())]
    for t in (0.0, 0.1, 0.2):
        measured = ranging.simulate(anchors, tags, np.eye(3), [3, 2, 1], noise, rng).ranges
        lines["ranges"] += [f"{t},{m},{n},{r}" for (m, n), r in np.ndenumerate(measured)]
        lines["truth"].append(f"{t},3,2,1,1,0,0,0")
    for name, text in lines.items():
        (folder / f"{name}.csv").write_text("\n".join(text) + "\n")
    (folder / "out").mkdir()
    layer = np.zeros((3, 22)), np.zeros(3)
    policy = policies.Policy((layer[0],), (layer[1],), "box", {"task": "auv_buoys"})
    policies.save(policy, folder / "out" / "auv_buoys-0.npz")
    own, pair, out = SET_KINDS["sight"][1]
    layers = ((np.zeros((2, own + pair)), np.zeros(2)),), ((np.zeros((out, own + 4)), np.zeros(1)),)
    chooser = SetPolicy(DeepSets(*layers), "sight", {"task": "halls"})
    policies.save(chooser, folder / "out" / "halls-0.npz")


def train_a_little(block: str, page: str, names: dict[str, object]) -> None:
    for long, short in SHORT.items():
        block = re.sub(long, short, block)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the learners
        exec(compile(block, page, "exec"), names)


@needs("cmaes")
@pytest.mark.usefixtures("coarse_design")
@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if blocks(page, "python") and page.stem != OF_ITS_OWN],
    ids=lambda page: page.stem,
)
def test_every_python_block_of_a_page_runs(page, monkeypatch, tmp_path, capsys):
    # What a block registers is forgotten after the test.
    monkeypatch.setattr(belief, "_FACTORIES", dict(belief._FACTORIES))
    monkeypatch.chdir(tmp_path)
    if page.stem == "studio":
        pytest.importorskip("viser", reason="needs the extra studio")
    if page.stem == "bags":
        pytest.importorskip("rosbags", reason="needs the extra bags")
        from tests import test_bags

        types = test_bags.types_of("ros1")
        messages = [
            ("/vicon/body" if topic == "/mocap/pose" else topic, time, message)
            for topic, time, message in test_bags.flight(types)
        ]
        test_bags.write_bag(tmp_path / "flight", "ros1", types, messages)
    monkeypatch.setattr(causes, "_RANGES", 500)
    monkeypatch.setattr(causes, "_FEWEST", 20)
    write_files_that_pages_read(tmp_path)
    module = ModuleType("of_the_page")  # classes of a page can be pickled, as in a notebook
    monkeypatch.setitem(sys.modules, module.__name__, module)
    names = vars(module)
    for block in blocks(page, "python"):
        code = compile(block, str(page.name), "exec")
        learners = FOREIGN.findall(block)
        if not learners:
            exec(code, names)
        elif all(importlib.util.find_spec(learner) for learner in learners):
            train_a_little(block, str(page.name), names)
    if page.stem == "unknown_motion":
        assert capsys.readouterr().out.startswith("(6,) (12, 12)\n")
        assert names["stream"].dropped == 0
        assert np.isfinite(names["links"].belief(names["stream"]).translation).all()


@pytest.mark.parametrize("page", [ROOT / "README.md", *PAGES], ids=lambda p: p.stem)
def test_every_command_of_a_page_is_one(page):
    parser = _parser()
    for block in blocks(page, "sh"):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words[:1] == ["rbl-gym"]:
                parser.parse_args(words[1:])


def test_every_page_is_in_the_navigation():
    named = re.findall(r"^ .*: ([\w/]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    assert sorted(named) == sorted(str(page.relative_to(ROOT / "docs")) for page in PAGES)


def test_notebooks_are_the_tutorials():
    spec = importlib.util.spec_from_file_location("make", ROOT / "examples/notebooks/make.py")
    assert spec is not None
    assert spec.loader is not None
    make = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(make)
    pages = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
    assert {page.stem for page in pages} == {
        book.stem for book in (ROOT / "examples" / "notebooks").glob("*.ipynb")
    }
    for page in pages:
        book = ROOT / "examples" / "notebooks" / f"{page.stem}.ipynb"
        assert book.read_text(encoding="utf-8") == make.notebook(page), "run make.py beside it"


def test_the_version_is_the_same_everywhere():
    stated = {
        name: re.search(pattern, (ROOT / name).read_text(), re.MULTILINE)
        for name, pattern in {
            "pyproject.toml": r'^version = "(.+)"',
            "CITATION.cff": r"^version: (.+)",
            "CHANGELOG.md": r"^## (\S+)",
        }.items()
    }
    assert {name: found and found[1] for name, found in stated.items()} == dict.fromkeys(
        stated, rbl_gym.__version__
    )
