"""Compilation of the functions that kernels call: once each, as LLVM code for linking.

By default numba compiles a function again for every literal and every memory layout of its
arguments, and generates machine code for each that never runs. All kernels together then take twice
as long. This module uses private names of numba for that. With versions of numba in which these
were not tried, everything compiles as numba does by default.
"""

from __future__ import annotations

import contextlib
import ctypes
import types
from collections.abc import Callable, Iterator
from typing import Any

import numba
from numba.core import config
from numba.core.types import Array, BaseFunction, BaseTuple, Boolean, Number, unliteral

# Oldest and newest version of numba with which this was tried.
_TRIED = ((0, 61), (0, 68))

# Fused multiply-add, a seventh of the time of an update. NaN and infinity remain what they are.
FUSED = {"contract"}

try:
    if not _TRIED[0] <= tuple(map(int, numba.__version__.split(".")[:2])) <= _TRIED[1]:
        raise ImportError
    from llvmlite.binding import parse_assembly
    from numba.core.codegen import JITCodeLibrary
    from numba.core.compiler import Compiler
    from numba.core.compiler_lock import global_compiler_lock
    from numba.core.registry import cpu_target

    _lock: Any = global_compiler_lock
    _target: Any = cpu_target
except ImportError:
    Compiler = JITCodeLibrary = _lock = _target = None

# The type annotations of numba omit some of its options.
_njit: Any = numba.njit
_config: Any = config


def _as_any(kind: Any) -> Any:
    """Return a common type of an argument: no literal, and arrays of any strides."""
    kind = unliteral(kind)
    return kind.copy(layout="A") if isinstance(kind, Array) else kind


def _counts_references(function: types.FunctionType) -> bool:
    """Return whether a helper creates arrays (it names `np`), or gets them from one that does."""
    names = function.__code__.co_names
    called = (function.__globals__.get(name) for name in names)
    return "np" in names or any(getattr(one, "gives_arrays", False) for one in called)


def compile_helper(function: Any, unrolled: bool, **options: Any) -> Callable[..., Any]:
    """Return a function for kernels to call; it has no entry point for Python.

    `unrolled` compiles once for each layout, and optimizes completely before inlining.
    """
    options |= {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    options |= {"error_model": "numpy", "fastmath": FUSED}
    if Compiler is None:
        return _njit(**options)(function)
    options["pipeline_class"] = _UnrolledCompiler if unrolled else _HelperCompiler
    # Otherwise references to each array are counted in every function that gets it.
    made = _njit(_nrt=_counts_references(function), **options)(function)
    made.gives_arrays = function.__annotations__.get("return") == "Any"
    find = made.get_call_template
    general = unliteral if unrolled else _as_any
    made.get_call_template = lambda args, kws: find(tuple(map(general, args)), kws)
    return made


@contextlib.contextmanager
def types_remembered() -> Iterator[None]:
    """Context in which the result types of operators are looked up only once.

    Otherwise numba tries all signatures of an operator at every place, a quarter of its time.
    """
    if Compiler is None:
        yield
        return
    find: Any = BaseFunction.get_call_type
    known: dict[Any, Any] = {}

    def get_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
        if kws or not all(map(_is_plain, args)):
            return find(self, context, args, kws)
        key = (self, args)
        if key not in known:
            known[key] = find(self, context, args, kws)
        return known[key]

    BaseFunction.get_call_type = get_call_type
    try:
        yield
    finally:
        BaseFunction.get_call_type = find


def _is_plain(kind: Any) -> bool:
    if isinstance(kind, BaseTuple):
        return all(map(_is_plain, kind))  # pyrefly: ignore[bad-argument-type]
    return isinstance(kind, (Number, Boolean, Array))


@contextlib.contextmanager
def _optimizing(level: int) -> Iterator[None]:
    """Context in which the optimizer works at a level from 0 to 3."""
    before = _config.OPT
    _config.OPT = type(before)(level)
    try:
        yield
    finally:
        _config.OPT = before


@contextlib.contextmanager
def as_code() -> Iterator[None]:
    """Context in which compiled code stays LLVM code, hardly optimized.

    Compilations in other threads wait.
    """
    if _target is None or _lock is None:
        yield
        return
    codegen = _target.target_context.codegen()
    with _lock, _optimizing(1):
        codegen._library_class = _Code
        try:
            yield
        finally:
            del codegen._library_class  # deletes the attribute of the instance


if Compiler is not None:

    class _Code(JITCodeLibrary):  # pyrefly: ignore[invalid-inheritance]
        """Functions as LLVM code; the libraries that link them generate machine code."""

        @property
        def codegen(self) -> Any:
            return self

        def set_env(self, name: str, env: Any) -> None:
            """Do nothing: the code is not in memory yet."""

        def magic_tuple(self) -> Any:
            """Return the target machine, as in the key on disk."""
            return self._codegen.magic_tuple()

        def get_pointer_to_function(self, name: str) -> int | None:
            """Return the code of a call from Python: a CPython function that raises TypeError."""
            return ctypes.cast(ctypes.pythonapi.PyErr_BadArgument, ctypes.c_void_p).value

        def serialize_using_object_code(self) -> Any:
            """Return only the names that loading needs: the code is in the linking library."""
            names = [one.name for one in self._final_module.global_variables]
            lines = [f'@"{name}" = common global i64 0' for name in names if "NumbaEnv" in name]
            return self.name, "bitcode", parse_assembly("\n".join(lines)).as_bitcode()

        def _finalize_final_module(self) -> None:
            self._finalize_dynamic_globals()
            self._finalized = True

    class _UnrolledCode(_Code):
        def _optimize_functions(self, ll_module: Any) -> None:
            with _optimizing(3):
                super()._optimize_functions(ll_module)

        def _optimize_final_module(self) -> None:
            with _optimizing(3):
                super()._optimize_final_module()

    class _HelperCompiler(Compiler):
        library = _Code

        def define_pipelines(self) -> Any:
            state: Any = self.state
            state.library = self.library(state.targetctx.codegen(), state.func_id.func_qualname)
            return super().define_pipelines()

    class _UnrolledCompiler(_HelperCompiler):
        library = _UnrolledCode
