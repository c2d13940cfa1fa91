"""Importing and drawing change nothing in the process."""

import matplotlib
import pytest

from rbl_gym.app.cli import main
from tests.helpers import needs, run_python


def test_a_checkouts_other_folders_are_no_part_of_the_package():
    told = run_python("""
import rbl_gym, rbl_gym.estimators, rbl_gym.wrappers
from importlib.util import find_spec
for folder in ("rbl_gym", "tests", "benchmarks", "examples", "docs"):
    print(find_spec(f"rbl_gym.{folder}"))
""")
    assert told == ["None"] * 5


def test_estimators_and_wrappers_are_those_of_the_same_checkout():
    told = run_python("""
import pathlib, sys
import rbl_gym, rbl_gym.wrappers, rbl_gym.estimators.locating.doa
root = pathlib.Path(rbl_gym.__file__).parent.parent
for module in (rbl_gym.wrappers, rbl_gym.estimators, rbl_gym.estimators.locating.doa):
    print(pathlib.Path(module.__file__).relative_to(root).as_posix())
print({"estimators", "wrappers"} & set(sys.modules))
""")
    assert told == [
        "wrappers/__init__.py", "estimators/__init__.py", "estimators/locating/doa.py", "set()",
    ]  # fmt: skip


@needs("cmaes")
@pytest.mark.parametrize(
    "command",
    [
        ["demo", "--trials", "2", "--plot", "p.png"],
        ["place", "--scene", "auv_buoys", "--anchors", "3", "--trials", "10", "--plot", "p.png"],
    ],
)
def test_pictures_leave_the_settings_of_matplotlib(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    before = dict(matplotlib.rcParams)
    assert main(command) == 0
    assert (tmp_path / "p.png").stat().st_size > 10_000
    assert dict(matplotlib.rcParams) == before
