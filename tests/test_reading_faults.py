"""Wrong files of a log are named together."""

from __future__ import annotations

import re

import numpy as np
import pytest

from rbl_gym.app.cli import main
from rbl_gym.recordings import Files, read_recording, read_runs
from tests import recorded
from tests.recorded import ROOM, flight

TAGS = np.array([[0.3, 0, 0], [-0.2, 0.25, 0], [-0.2, -0.2, 0.1]])


@pytest.fixture
def files(tmp_path):
    log = flight(TAGS, count=5)
    assert log.truth is not None
    return recorded.files(tmp_path, ROOM, TAGS, log.times, log.ranges, log.truth[1:3])


def damage(path, old, new):
    with open(path, encoding="utf-8") as file:
        text = file.read()
    assert old in text
    with open(path, "w", encoding="utf-8") as file:
        file.write(text.replace(old, new, 1))


FAULTS = {
    "anchors": ("anchor,", "name_of_it,", r"anchors\.csv, line 1: missing column 'anchor'"),
    "tags": ("0,0.3,", "0,abc,", r"tags\.csv, line 2, column 'x': .*'abc'"),
    "truth": ("qw,", "bogus,", r"truth\.csv, line 1: missing column 'qw'"),
}


@pytest.mark.parametrize("read", [read_recording, read_runs])
@pytest.mark.parametrize(
    "wrong", [("anchors",), ("anchors", "truth"), ("tags", "truth"), ("anchors", "tags", "truth")]
)
def test_every_wrong_file_is_named(files, wrong, read):
    for name in wrong:
        damage(files[name], *FAULTS[name][:2])
    with pytest.raises(ValueError, match=FAULTS[wrong[0]][2]) as error:
        read(Files(**files))
    lines = str(error.value).splitlines()
    assert len(lines) == (1 if len(wrong) == 1 else 1 + len(wrong))
    assert len(wrong) == 1 or lines[0] == f"{len(wrong)} files cannot be used:"
    for name in FAULTS:
        said = [line for line in lines if re.search(FAULTS[name][2], line)]
        assert len(said) == (name in wrong)


def test_missing_files_and_wrong_ones_are_named_together(files, capsys):
    damage(files["truth"], *FAULTS["truth"][:2])
    options = recorded.options({**files, "tags": files["tags"] + "x"})
    assert main(["replay", *options]) == 2
    first, *others = capsys.readouterr().err.splitlines()
    assert first == "rbl-gym replay: 2 files cannot be used:"
    assert others[0].endswith("tags.csvx: No such file or directory")
    assert "missing column 'qw'" in others[1]
