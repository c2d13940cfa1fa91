"""Compilation and storage of kernels: numba, without fast math but for FMA, cached by contents.

Only modules of kernels import this one. It imports numba.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import hashlib
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any, TypeVar, cast

import numba
from numba.core import event

from rbl_gym.kernels.helper_code import FUSED, as_code, compile_helper, types_remembered

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None

F = TypeVar("F", bound=Callable[..., Any])

_FOLDER = Path(__file__).parent
_TYPES = {"f": numba.float64, "i": numba.int64, "b": numba.boolean}
_LOG = logging.getLogger("rbl_gym.kernels")


@functools.cache
def _announce() -> None:
    """Log, once in a process, that kernels compile."""
    _LOG.info("compiling kernels, up to a minute; later runs of this command load them")


class _Passes(event.Listener):
    """Listener to the passes of the compiler. Loading a kernel from disk runs none."""

    def on_start(self, event: Any) -> None:
        _announce()

    def on_end(self, event: Any) -> None:
        pass


def contents_hash(folder: Path) -> str:
    """Return a hash of all modules in a folder."""
    digest = hashlib.sha256()
    for file in sorted(folder.glob("*.py")):
        digest.update(file.name.encode())
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _keyed(base: Any, stamp: str) -> Any:
    """Return a cache locator of numba for our kernels only; `stamp` detects stale ones."""

    class Locator(base):
        def get_source_stamp(self) -> str:
            return stamp

        def get_disambiguator(self) -> str:
            # Instead of the line number: no second file if a kernel has moved.
            return "kernel"

        @classmethod
        def from_function(cls, function: Any, file: str) -> Any:
            ours = Path(file).parent == _FOLDER
            return super().from_function(function, file) if ours else None

    return Locator


def _find_cache() -> Path | None:
    """Return the folder of cached kernels; None if they are not cached.

    numba considers a kernel stale if its own file changes. Ours are stale if any file of this
    package changes. There is no public interface for this. If the private names are missing, or no
    folder is writable, every process compiles again.
    """
    try:
        from numba.core import caching

        stamp = contents_hash(_FOLDER)
        # The first is for NUMBA_CACHE_DIR. Before numba 0.62 the names began with an underscore.
        names = ("UserProvidedCacheLocator", "InTreeCacheLocator", "UserWideCacheLocator")
        own = "" if hasattr(caching, names[0]) else "_"
        ours = [_keyed(getattr(caching, own + name), stamp) for name in names]
        caching.CacheImpl._locator_classes[:0] = ours
        for locator in ours:
            found = locator.from_function(contents_hash, __file__)
            if found is not None:
                found.ensure_cache_path()
                return Path(found.get_cache_path())
    except (ImportError, AttributeError, OSError):
        pass
    return None


_CACHE = _find_cache()
_KEPT = _CACHE is not None


@contextlib.contextmanager
def _alone() -> Iterator[None]:
    """Context in which only one process compiles; the others then load its results from disk.

    A kernel is stored in several files. Those of one process call functions by names that those of
    another do not have. A mixture crashes the interpreter.
    """
    with _lock_file() as file:
        if file is not None and fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_EX)  # released when the file closes
        yield


@contextlib.contextmanager
def _in_haste() -> Iterator[None]:
    """Context without garbage collection, which takes a seventh of the compilation time."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


@contextlib.contextmanager
def _loading_alone() -> Iterator[None]:
    """Context in which numba loads what is stored without first loading its means to compile.

    These take a quarter of a second. numba loads them anyway before it compiles.
    """
    try:
        from numba.core.caching import Cache
        from numba.core.runtime.nrt import rtsys
    except ImportError:  # private names of numba
        yield
        return
    find: Any = Cache.load_overload

    def load_overload(self: Any, sig: Any, target_context: Any) -> Any:
        target_context.refresh = lambda: rtsys.initialize(target_context)
        try:
            return find(self, sig, target_context)
        finally:
            del target_context.refresh  # deletes the attribute of the instance

    Cache.load_overload = load_overload
    try:
        yield
    finally:
        Cache.load_overload = find


def _compile(function: Callable[..., Any], signature: str, arguments: tuple[Any, ...]) -> Any:
    """Return a generalized ufunc of a function.

    numba compiles the function, then the loop over trials with the function inlined. Only the
    second step is optimized.
    """
    made: Any = numba.guvectorize(signature, cache=_KEPT, fastmath=FUSED)(function)
    with as_code(), event.install_listener("numba:run_pass", _Passes()):
        made.add(arguments)
    made.disable_compile()
    return made.build_ufunc()


def _forget(function: Callable[..., Any]) -> bool:
    """Delete the files of a kernel; return whether there were any."""
    name = f"{function.__module__.rpartition('.')[2]}.{function.__name__}-"
    files = [] if _CACHE is None else [*_CACHE.glob(f"*{name}*.nb?")]
    for file in files:
        file.unlink(missing_ok=True)
    return bool(files)


def _lock_file() -> contextlib.AbstractContextManager[IO[str] | None]:
    if _CACHE is None or fcntl is None:
        return contextlib.nullcontext()
    try:
        return (_CACHE / "kernels.lock").open("w")
    except OSError:
        return contextlib.nullcontext()


def helper(function: F) -> F:
    """Compile a function that kernels call; division by zero gives inf, as in NumPy.

    Python cannot call it.
    """
    return cast(F, compile_helper(function, unrolled=False))


def inlined(function: F, unrolled: bool = False) -> F:
    """Compile a `helper` that is inlined: for inner functions with few call sites.

    A call takes 0.1 us or more, because an array is passed as seven numbers. `unrolled` is for
    loops of known length over matrices: they are faster if unrolled before inlining.
    """
    return cast(F, compile_helper(function, unrolled, forceinline=True))


def gufunc(signature: str, types: str = "") -> Callable[[F], F]:
    """Return a decorator that makes a generalized ufunc; the function writes its last arguments.

    The function itself does not change; its attribute ``build()`` compiles it, once. The signature
    is as in NumPy, such as ``"(d,d),(d),()->(d)"``; an output ``()`` is written as ``out[0]``.
    `types` has one letter for each argument: f (float64), i (int64) or b (bool). Empty: all f.
    """
    axes = [part.strip("()") for part in signature.replace("->", ",").replace(" ", "").split("),")]
    ranks = [part.count(",") + 1 if part else 0 for part in axes]
    inputs = signature.split("->")[0].count("(")

    def decorate(function: F) -> F:
        @functools.cache
        def build() -> Any:
            letters = types or "f" * len(ranks)
            arguments = []
            for place, (letter, rank) in enumerate(zip(letters, ranks, strict=True)):
                # Outputs are arrays even if they have no axes.
                rank = rank if place < inputs else max(rank, 1)
                kind = _TYPES[letter]
                arguments.append(kind[(slice(None),) * rank] if rank else kind)
            with _alone(), _in_haste(), types_remembered(), _loading_alone():
                try:
                    made = _compile(function, signature, tuple(arguments))
                except Exception:
                    # A process that ended between the two steps leaves the files of the first one
                    # only, with which numba cannot compile the second.
                    if not _forget(function):
                        raise
                    made = _compile(function, signature, tuple(arguments))
            # The wrapper of numba around NumPy's ufunc takes a microsecond per call.
            return getattr(made, "ufunc", made)

        function.build = build  # pyrefly: ignore[missing-attribute]
        return function

    return decorate
