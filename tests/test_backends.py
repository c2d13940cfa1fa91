"""Sweeps on several workers: the same bytes as in one process, even if workers die."""

from __future__ import annotations

import json
import os
import tempfile
import uuid
from pathlib import Path

import pytest

from rbl_gym.app.cli import main
from rbl_gym.studies import backends
from tests import fragile

pytest.importorskip("joblib", reason="needs the extra parallel")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two short scenes, and the records of one process."""
    folder = tmp_path_factory.mktemp("bench")
    for name in ("uwb_room", "auv_buoys"):
        (folder / f"{name}_5.json").write_text(json.dumps({"name": name, "steps": 4}))
    assert bench(folder, "serial") == 0
    return folder


def bench(folder: Path, name: str, *arguments: str, filters: str = "kf,iekf") -> int:
    files = ",".join(sorted(map(str, folder.glob("*_5.json"))))
    return main(["bench", "--scenes", files, "--filters", filters, "--conditions", "nominal,nlos",
                 "--trials", "5", "--out", str(folder / f"{name}.jsonl"), *arguments])  # fmt: skip


def same(folder: Path, name: str, other: str = "serial") -> bool:
    first, second = ((folder / f"{n}.jsonl").read_bytes() for n in (name, other))
    return len(first) > 1000 and first == second


@pytest.fixture(scope="module")
def cluster():
    """A real dask cluster with two workers, processes of their own."""
    distributed = pytest.importorskip("distributed", reason="needs the extra parallel")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50
    ) as cluster:
        yield cluster


def test_ray_gives_the_bytes_of_one_process(folder):
    pytest.importorskip("ray", reason="ray is not installed")
    assert bench(folder, "ray", "--backend", "ray", "--jobs", "2") == 0
    assert same(folder, "ray")


@pytest.fixture
def killer(monkeypatch):
    """A filter that kills the first worker that makes it, and the file that says it did."""
    monkeypatch.setenv(fragile.PARENT, str(os.getpid()))
    path = Path(tempfile.gettempdir()) / f"rbl-gym-{uuid.uuid4().hex}"
    yield f"tests.fragile:kills_its_worker/marker={path.name}", path
    path.unlink(missing_ok=True)


def test_two_processes_give_the_bytes_of_one_even_if_one_dies(folder, killer):
    name, marker = killer
    assert bench(folder, "killed", "--jobs", "2", filters=f"kf,{name}") == 0
    assert int(marker.read_text()) != os.getpid()
    assert bench(folder, "alive", filters=f"kf,{name}") == 0
    assert same(folder, "killed", "alive")
    assert main(["rerun", str(folder / "killed.jsonl"), "--jobs", "2"]) == 0


def test_two_dask_workers_give_the_bytes_of_one_even_if_one_dies(folder, cluster, killer):
    name, marker = killer
    options = ("--backend", "dask", "--address", cluster.scheduler_address)
    assert bench(folder, "killed-dask", *options, filters=f"kf,{name}") == 0
    assert int(marker.read_text()) != os.getpid()
    assert bench(folder, "alive-dask", filters=f"kf,{name}") == 0
    assert same(folder, "killed-dask", "alive-dask")


def test_a_task_that_kills_every_worker_is_an_error_that_names_it(monkeypatch):
    monkeypatch.setattr(backends, "_PATIENCE", 1)

    def dies(task):
        os.kill(os.getpid(), 9)

    with pytest.raises(
        ChildProcessError, match=r"workers died 1 times .* 1 tasks left, .* them poison"
    ):
        list(backends.each(dies, ["poison"], backends.Workers(jobs=2)))


def test_a_missing_backend_names_its_extra(folder, monkeypatch, capsys):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert bench(folder, "none", "--jobs", "2") == 2
    assert "pip install 'rbl-gym[parallel]'" in capsys.readouterr().err
