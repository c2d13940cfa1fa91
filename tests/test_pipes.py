"""The command line whose reader goes away, as with `| head`: it ends without a word."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from rbl_gym.app.cli import READER_GONE, main
from tests.helpers import ROOT

# The first starts of an interpreter are slow on a busy machine.
PATIENCE_S = 120
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "RBL_GYM_COMPILED": "0"}


@pytest.fixture
def replay(tmp_path):
    """The command to replay the start of a log."""
    command = ["replay"]
    for name in ("ranges", "anchors", "tags", "truth"):
        text = (ROOT / "examples" / "log" / f"{name}.csv").read_text().splitlines()[:40]
        (tmp_path / f"{name}.csv").write_text("\n".join(text))
        command += [f"--{name}", str(tmp_path / f"{name}.csv")]
    return command


def ended(arguments, together=False):
    """Status and standard error of a command whose standard output nobody reads.

    `together`: nobody reads standard error either.
    """
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-m", "rbl_gym.app", *arguments],
        cwd=ROOT,
        env=ENVIRONMENT,
        stdout=writer,
        stderr=subprocess.STDOUT if together else subprocess.PIPE,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    os.close(writer)
    return done.returncode, done.stderr


@pytest.mark.parametrize("shown", ["tables", "help"])
def test_a_command_without_a_reader_ends_quietly(shown, replay):
    status, said = ended(replay if shown == "tables" else ["replay", "--help"])
    # argparse does not tell that its help had no reader.
    assert status == READER_GONE or (status == 0 and shown == "help")
    # The progress bar of rich is all that may be there.
    assert all(line.startswith("replay ") for line in said.splitlines()), said


def test_a_command_ends_quietly_if_nobody_reads_its_errors_either():
    assert ended(["replay", "--ranges", "nowhere.csv"], together=True)[0] == READER_GONE


def test_without_a_command_all_commands_are_listed(capsys):
    assert main([]) == 2
    told = capsys.readouterr().err
    assert all(f"    {name} " in told for name in ("demo", "place", "replay", "studio"))


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
def test_a_full_disk_is_reported_in_a_line(replay):
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "rbl_gym.app", *replay, "--json"],
            cwd=ROOT,
            env=ENVIRONMENT,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
    assert done.returncode == 2
    assert "rbl-gym replay: [Errno 28] No space left on device" in done.stderr.splitlines()
