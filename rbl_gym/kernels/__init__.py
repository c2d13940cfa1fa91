"""Compiled forms of what is computed most: plain loops over one trial, broadcast by numba.

Every function on a hot path has a textbook form in NumPy, which stands where it is used, and may
have a kernel of the same signature here. `compiled` joins the two: where numba is installed
(extra ``fast``) a call runs the kernel, elsewhere the textbook form. ``RBL_GYM_COMPILED=0``
switches the kernels off. A kernel is compiled at its first call and kept on disk; importing
`rbl_gym` never imports numba.
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


# A context in which NumPy warns of nothing.
_QUIET = contextvars.copy_context()
_QUIET.run(np.seterr, all="ignore")


@functools.cache
def enabled() -> bool:
    """Whether calls run kernels: numba is there, and ``RBL_GYM_COMPILED`` is not 0."""
    if os.environ.get("RBL_GYM_COMPILED", "1") == "0" or find_spec("numba") is None:
        return False
    try:
        importlib.import_module("numba")
    except ImportError as error:
        # numba refuses versions of NumPy that are newer than itself.
        warnings.warn(f"numba does not import, kernels are off: {error}", stacklevel=2)
        return False
    return True


def _under_errstate(function: Callable[..., Any], *args: Any) -> Any:
    with np.errstate(all="ignore"):
        return function(*args)


class Compiled:
    """A function with a textbook form and a kernel, made by `compiled`.

    It takes positional arguments only, and runs with floating point warnings off: NaN in gives
    NaN out, and whoever calls says what that means. It pickles by its name, as functions do.

    Attributes
    ----------
    textbook
        The form in NumPy.
    kernel
        The generalized ufunc; its first use compiles it, or loads it from the disk.
    """

    __slots__ = ("__dict__", "_run", "name", "textbook")

    def __init__(self, name: str, textbook: Callable[..., Any]) -> None:
        functools.update_wrapper(self, textbook)
        self.name = name
        self.textbook = textbook
        self._run: Callable[..., Any] | None = None

    @property
    def kernel(self) -> Callable[..., Any]:
        """The compiled form; ModuleNotFoundError without numba."""
        module, function = self.name.split(":")
        return getattr(importlib.import_module(f"rbl_gym.kernels.{module}"), function).build()

    def __call__(self, *args: Any) -> Any:
        """The kernel or the textbook form of the arguments."""
        run = self._run or self._choose()
        try:
            return run(*args)
        except RuntimeError:
            # Another thread is in the quiet context; it calls nothing of ours, which could be us.
            return _under_errstate(self.kernel if enabled() else self.textbook, *args)

    def _choose(self) -> Callable[..., Any]:
        """The form to run, from the first call on; in a tenth of errstate's time if compiled."""
        if enabled():
            self._run = functools.partial(_QUIET.run, self.kernel)
        else:
            self._run = functools.partial(_under_errstate, self.textbook)
        return self._run

    def __reduce__(self) -> str:
        return self.__qualname__  # pyright: ignore[reportAttributeAccessIssue]


def compiled(name: str) -> Callable[[Callable[..., Any]], Compiled]:
    """A decorator of a textbook form: calls run the kernel `name`, where there is one to run.

    Parameters
    ----------
    name
        ``"module:function"``, of a function in this package that `rbl_gym.kernels.jit.gufunc`
        decorates. It takes the same arguments as the textbook form, which has to broadcast over
        leading axes as the kernel does.
    """
    return functools.partial(Compiled, name)


def compile_all() -> None:
    """Compile every kernel that is not on disk yet; nothing where kernels are off."""
    if not enabled():
        return
    for module in pkgutil.iter_modules(__path__):
        for function in vars(importlib.import_module(f"{__name__}.{module.name}")).values():
            if hasattr(function, "build"):
                function.build()
