"""Compiled forms of the most frequent computations: plain loops over one trial, by numba.

Every function on a hot path has a textbook form in NumPy, in the module that uses it. It may also
have a kernel here with the same signature, which numba broadcasts. `compiled` joins the two: if
numba is installed (extra ``fast``) a call runs the kernel, otherwise the textbook form.
``RBL_GYM_COMPILED=0`` turns the kernels off. A kernel is compiled at its first call and stored on
disk. Importing `rbl_gym` never imports numba.
"""

from __future__ import annotations

import contextvars
import functools
import importlib
import os
import pkgutil
import warnings
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np

__all__ = ["Compiled", "compile_all", "compiled", "enabled"]


# A context in which NumPy emits no warnings.
_QUIET = contextvars.copy_context()
_QUIET.run(np.seterr, all="ignore")


@functools.cache
def enabled() -> bool:
    """Return whether calls run kernels: numba is installed, and ``RBL_GYM_COMPILED`` is not 0."""
    if os.environ.get("RBL_GYM_COMPILED", "1") == "0" or find_spec("numba") is None:
        return False
    try:
        importlib.import_module("numba")
    except ImportError as error:
        # numba does not support versions of NumPy that are newer than itself.
        warnings.warn(
            "compiled kernels are off and calculations are slower: numba is installed but cannot "
            f"be imported ({error}). Install versions of numba and numpy that fit together, or set "
            "RBL_GYM_COMPILED=0 to hide this warning.",
            stacklevel=2,
        )
        return False
    return True


def _under_errstate(function: Callable[..., Any], *args: Any) -> Any:
    with np.errstate(all="ignore"):
        return function(*args)


class Compiled:
    """A function with a `textbook` form in NumPy and a `kernel`, created by `compiled`.

    It takes positional arguments only, and runs with floating-point warnings off: NaN inputs give
    NaN outputs, which callers must handle. Like functions, it is pickled by name.
    """

    __slots__ = ("__dict__", "_run", "name", "textbook")

    def __init__(self, name: str, textbook: Callable[..., Any]) -> None:
        functools.update_wrapper(self, textbook)
        self.name = name
        self.textbook = textbook
        self._run: Callable[..., Any] | None = None

    @property
    def kernel(self) -> Callable[..., Any]:
        """The compiled form; raises ModuleNotFoundError without numba."""
        module, function = self.name.split(":")
        return getattr(importlib.import_module(f"rbl_gym.kernels.{module}"), function).build()

    def __call__(self, *args: Any) -> Any:
        """Apply the kernel or the textbook form to the arguments."""
        run = self._run or self._choose()
        try:
            return run(*args)
        except RuntimeError:
            # Another thread is in the quiet context. It calls none of our functions, which could be
            # this one.
            return _under_errstate(self.kernel if enabled() else self.textbook, *args)

    def _choose(self) -> Callable[..., Any]:
        """Choose the form at the first call.

        The context of compiled forms takes a tenth of the time of errstate.
        """
        if enabled():
            self._run = functools.partial(_QUIET.run, self.kernel)
        else:
            self._run = functools.partial(_under_errstate, self.textbook)
        return self._run

    def __reduce__(self) -> str:
        return self.__qualname__  # pyrefly: ignore[missing-attribute]


def compiled(name: str) -> Callable[[Callable[..., Any]], Compiled]:
    """Return a decorator of a textbook form: calls run the kernel `name` if it is available.

    The kernel is ``"module:function"`` of a function in this package decorated with
    `rbl_gym.kernels.jit.gufunc`. It takes the same arguments as the textbook form, which must
    broadcast over leading axes as the kernel does.
    """
    return functools.partial(Compiled, name)


def compile_all() -> None:
    """Compile every kernel that is not on disk yet; does nothing if kernels are off."""
    if not enabled():
        return
    for module in pkgutil.iter_modules(__path__):
        for function in vars(importlib.import_module(f"{__name__}.{module.name}")).values():
            if hasattr(function, "build"):
                function.build()
