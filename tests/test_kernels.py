"""Common parts of the kernels: dispatch, cache, small matrices, rotations."""

from __future__ import annotations

import functools
import importlib
import multiprocessing
import pickle
import subprocess
import sys
import types
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rbl_gym import kernels
from rbl_gym.geometry import rotations
from tests.helpers import ROOT, run_python

needs_numba = pytest.mark.skipif(not kernels.enabled(), reason="kernels are off")


@kernels.compiled("of_this_test:half")
def half(x):
    """Half of x (...)."""
    return np.asarray(x) / 2


@pytest.fixture
def kernel_of_half(monkeypatch):
    """A kernel that can be told from its textbook form: it doubles."""
    from rbl_gym.kernels.jit import gufunc

    def double(x, out):
        out[0] = 2 * x

    module = types.SimpleNamespace(half=gufunc("()->()")(double))
    monkeypatch.setitem(sys.modules, "rbl_gym.kernels.of_this_test", module)
    monkeypatch.setattr(half, "_run", None)


# --- which form runs --------------------------------------------------------------------------


@needs_numba
def test_a_call_runs_the_kernel_and_broadcasts(kernel_of_half):
    assert half(3.0) == 6.0
    np.testing.assert_array_equal(half(np.ones((2, 1, 3))), np.full((2, 1, 3), 2.0))
    assert half.textbook(3.0) == 1.5
    assert half.kernel(3.0) == 6.0
    assert getattr(half, "__name__", "") == "half"
    assert half.__doc__ == "Half of x (...)."


@needs_numba
def test_the_command_line_says_once_that_kernels_compile(capsys, caplog, monkeypatch):
    from rbl_gym.app.cli import main
    from rbl_gym.kernels import jit

    caplog.set_level("INFO", "rbl_gym.kernels")
    monkeypatch.setattr(jit, "_KEPT", False)
    with pytest.raises(SystemExit, match="0"):
        main(["--version"])
    capsys.readouterr()
    jit._announce.cache_clear()

    def double(x, out):
        out[0] = 2 * x

    for _ in range(2):
        lazy: Any = jit.gufunc("()->()")(double)
        assert lazy.build()(1.0) == 2.0
    said = capsys.readouterr()
    assert said.out == ""
    (line,) = said.err.splitlines()
    assert line.startswith("rbl-gym: compiling kernels, up to a minute; later runs")


def test_without_kernels_the_textbook_form_runs(monkeypatch):
    monkeypatch.setattr(kernels, "enabled", lambda: False)
    monkeypatch.setattr(half, "_run", None)
    assert half(3.0) == 1.5


def test_the_environment_switches_kernels_off():
    code = """
import os, sys
os.environ["RBL_GYM_COMPILED"] = "0"
from rbl_gym import kernels
kernels.compile_all()
print(kernels.enabled(), "numba" in sys.modules)
"""
    assert run_python(code) == ["False False"]


def test_a_numba_that_does_not_import_is_a_warning(monkeypatch):
    monkeypatch.setattr(kernels, "find_spec", lambda name: object())
    monkeypatch.delenv("RBL_GYM_COMPILED", raising=False)
    monkeypatch.setitem(sys.modules, "numba", None)
    kernels.enabled.cache_clear()
    with pytest.warns(UserWarning, match="kernels are off.*Install versions of numba"):
        assert not kernels.enabled()
    kernels.enabled.cache_clear()


@needs_numba
def test_nan_makes_no_warning_in_either_form(kernel_of_half, monkeypatch):
    assert np.isnan(half(np.nan))
    monkeypatch.setattr(kernels, "enabled", lambda: False)
    monkeypatch.setattr(half, "textbook", lambda x: np.sqrt(x))
    monkeypatch.setattr(half, "_run", None)
    assert np.isnan(half(-1.0))


@needs_numba
def test_it_runs_within_another_call_of_itself(kernel_of_half):
    """As a second thread does while the first is in the same quiet context."""
    assert kernels._QUIET.run(lambda: half(np.nan)) != 0


# --- pickles ----------------------------------------------------------------------------------


def test_it_pickles_by_its_name():
    assert pickle.loads(pickle.dumps(half)) is half
    cloudpickle = pytest.importorskip("cloudpickle")
    assert cloudpickle.loads(cloudpickle.dumps(half)) is half
    # As part of a function that travels by value, as to a worker of dask.
    doubled = cloudpickle.loads(cloudpickle.dumps(lambda x: half.textbook(x) * 4))
    assert doubled(3.0) == 6.0


def test_a_spawned_worker_finds_it(monkeypatch):
    monkeypatch.setenv("RBL_GYM_COMPILED", "0")
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.apply(half, (3.0,)) == 1.5


# --- the cache --------------------------------------------------------------------------------

_KERNEL = """
from rbl_gym.kernels.helper import factor
from rbl_gym.kernels.jit import gufunc

@gufunc("()->()")
def scaled(x, out):
    out[0] = factor() * x
"""
_HELPER = """
from rbl_gym.kernels.jit import helper

@helper
def factor():
    return {}
"""


def package_of_its_own(tmp_path):
    """A copy of how kernels are compiled, with one kernel; its folder."""
    package = tmp_path / "rbl_gym" / "kernels"
    package.mkdir(parents=True)
    (tmp_path / "rbl_gym" / "__init__.py").touch()
    for file in ("__init__.py", "jit.py", "helper_code.py"):
        (package / file).write_bytes((ROOT / "rbl_gym" / "kernels" / file).read_bytes())
    (package / "kernel.py").write_text(_KERNEL)
    return package


@needs_numba
def test_a_kernel_on_disk_is_stale_when_a_helper_in_another_file_changes(tmp_path):
    package = package_of_its_own(tmp_path)
    code = f"""
sys.path.insert(0, {str(tmp_path)!r})
from rbl_gym.kernels import kernel
print(kernel.scaled.build()(1.0))
"""
    saved = set()
    for value in (2.0, 3.0, 3.0):
        (package / "helper.py").write_text(_HELPER.format(value))
        assert run_python(code) == [str(value)]
        saved.add(tuple(sorted((f.name, f.stat().st_mtime_ns) for f in package.rglob("*.nb?"))))
    # A process that was stopped while it compiled leaves one of two files.
    for file in (package / "__pycache__").glob("guf-*"):
        file.unlink()
    assert run_python(code) == ["3.0"]
    # Compiled twice, the third time loaded; nothing stale is left behind.
    assert len(saved) == 2
    assert len({len(files) for files in saved}) == 1
    assert all(files for files in saved)


@needs_numba
def test_an_untried_numba_compiles_in_its_own_way(tmp_path):
    package = package_of_its_own(tmp_path)
    (package / "helper.py").write_text(_HELPER.format(2.0))
    code = f"""
import sys
import numba
numba.__version__ = "99.0.0"
sys.path.insert(0, {str(tmp_path)!r})
from rbl_gym.kernels import helper_code, kernel
print(helper_code.Compiler)
print(kernel.scaled.build()(1.0))
"""
    assert run_python(code) == ["None", "2.0"]


@needs_numba
def test_one_process_compiles_at_a_time(tmp_path):
    fcntl = pytest.importorskip("fcntl")
    package = package_of_its_own(tmp_path)
    (package / "helper.py").write_text(_HELPER.format(2.0))
    code = f"""
import sys
sys.path.insert(0, {str(tmp_path)!r})
from rbl_gym.kernels import kernel
print("ready", flush=True)
print(kernel.scaled.build()(1.0))
"""
    cache = package / "__pycache__"
    cache.mkdir()
    with (cache / "kernels.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        other = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
        assert other.stdout is not None
        assert other.stdout.readline() == "ready\n"
        with pytest.raises(subprocess.TimeoutExpired):
            other.wait(0.5)
        assert not list(cache.glob("*scaled*"))
    assert other.communicate(timeout=120)[0] == "2.0\n"
    assert list(cache.glob("*scaled*"))


# --- small matrices and rotations -------------------------------------------------------------


@functools.cache
def from_python(helper):
    """A helper of kernels, which has no entry of its own for Python, by a function that has one."""
    return importlib.import_module("numba").njit(lambda *args: helper(*args))


@needs_numba
def test_a_helper_tells_python_that_it_cannot_be_called():
    from rbl_gym.kernels import linear_algebra as la

    matrix = np.zeros((2, 2))
    for _ in range(2):
        with pytest.raises(TypeError):
            la.fill(1.0, matrix)
    from_python(la.fill)(1.0, matrix)
    assert np.all(matrix == 1.0)


def positive(rng, n):
    root = rng.standard_normal((n, n)) * np.logspace(-3, 3, n)
    return root.T @ root


@needs_numba
@pytest.mark.parametrize(("n", "size"), [(1, 0), (3, 0), (6, 0), (6, 6)])
def test_factor_solution_and_inverse_equal_numpy(n, size):
    from rbl_gym.kernels import linear_algebra as la

    cholesky, solve_factored, invert_factored = map(
        from_python,
        {
            0: (la.cholesky, la.solve_factored, la.invert_factored),
            6: (la.cholesky6, la.solve_factored6, la.invert_factored6),
        }[size],
    )
    rng = np.random.default_rng(n)
    A, b = positive(rng, n), rng.standard_normal(n)
    L, x, P = np.zeros((n, n)), np.empty(n), np.empty((n, n))
    assert cholesky(np.tril(A), L)
    want = np.linalg.cholesky(A)
    np.testing.assert_allclose(np.diag(L), 1 / np.diag(want), rtol=1e-9)
    np.testing.assert_allclose(np.tril(L, -1), np.tril(want, -1), rtol=1e-9)
    solve_factored(L, b, x)
    np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-8)
    invert_factored(L, P)
    want = np.linalg.inv(A)
    scale = np.sqrt(np.outer(np.diag(want), np.diag(want)))
    np.testing.assert_allclose(P / scale, want / scale, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(P, P.T)


@needs_numba
def test_a_singular_matrix_is_told_and_solved_where_it_can_be():
    from rbl_gym.kernels import linear_algebra as la

    A = np.diag([4.0, 0.0, 1.0])
    L, x = np.zeros((3, 3)), np.empty(3)
    cholesky, solve_factored = from_python(la.cholesky), from_python(la.solve_factored)
    assert not cholesky(A, L)
    solve_factored(L, np.array([8.0, 0.0, 3.0]), x)
    np.testing.assert_allclose(x, [2.0, 0.0, 3.0])
    assert not cholesky(np.full((3, 3), np.nan), L)
    assert np.isnan(L[0, 0])


@needs_numba
def test_product_equals_numpy():
    from rbl_gym.kernels import linear_algebra as la

    rng = np.random.default_rng(1)
    A, B, out = rng.standard_normal((2, 4)), rng.standard_normal((4, 3)), np.empty((2, 3))
    from_python(la.multiply)(A, B, out)
    np.testing.assert_allclose(out, A @ B, rtol=1e-14)


def rotation_vectors():
    """Lengths from 1e-9 to pi, many of them near the ends, and zero."""
    rng = np.random.default_rng(2)
    length = np.concatenate(
        [[0.0, np.pi], 10 ** rng.uniform(-9, np.log10(np.pi), 200),
         np.pi - 10 ** rng.uniform(-9, -1, 100), 0.5 + rng.uniform(-1e-9, 1e-9, 20)]
    )  # fmt: skip
    axis = rng.standard_normal((len(length), 3))
    axis[:30] = np.round(axis[:30])
    axis[(axis == 0).all(axis=1)] = [1.0, 0.0, 0.0]
    return length[:, None] * axis / np.linalg.norm(axis, axis=1, keepdims=True)


@needs_numba
def test_rotations_equal_scipy_and_the_textbook_forms():
    from rbl_gym.kernels import rotations as ours

    exp, log = from_python(ours.exp), from_python(ours.log)
    jacobian = from_python(ours.left_jacobian)
    jacobian_inverse = from_python(ours.left_jacobian_inverse)
    vectors = rotation_vectors()
    R, J, inverse = np.empty((3, len(vectors), 3, 3))
    back = np.empty_like(vectors)
    for k, (x, y, z) in enumerate(vectors.tolist()):
        exp(x, y, z, R[k])
        back[k] = log(R[k])
        jacobian(x, y, z, J[k])
        jacobian_inverse(x, y, z, inverse[k])
    np.testing.assert_allclose(R, Rotation.from_rotvec(vectors).as_matrix(), atol=1e-14)
    # At pi both ends of the axis are right.
    length = np.linalg.norm(vectors, axis=1)
    other = (length > np.pi - 1e-7) & ((back * vectors).sum(axis=1) < 0)
    back[other] *= -1
    assert (np.abs(back - vectors).max(axis=1) <= 3e-15 + 1e-15 * length).all()
    np.testing.assert_allclose(J, rotations.left_jacobian(vectors), atol=1e-14)
    np.testing.assert_allclose(J @ inverse, np.tile(np.eye(3), (len(vectors), 1, 1)), atol=1e-13)
