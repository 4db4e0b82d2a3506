"""Functions of LAPACK and BLAS that NumPy lacks, as SciPy has them.

`scipy.linalg` takes longer to import than a small solve takes. What it wraps are two extension modules, which
are loaded here without the package around them; from the package, where it keeps them elsewhere.
"""

import sys
from collections.abc import Callable
from functools import cache
from importlib.machinery import PathFinder
from importlib.util import module_from_spec
from pathlib import Path
from typing import Any, NamedTuple

import scipy

__all__ = ["Lapack", "lapack"]

_Function = Callable[..., Any]


class Lapack(NamedTuple):
    """The functions, as `scipy.linalg.lapack` and `scipy.linalg.blas` document them."""

    dpstrf: _Function
    """Cholesky factorisation with pivots."""
    dgerqf: _Function
    """RQ factorisation."""
    dtzrzf: _Function
    """Trapezoid to triangle."""
    dtrsm: _Function
    """Solution of a triangular system."""
    dtrmm: _Function
    """Product with a triangular matrix."""


@cache
def lapack() -> Lapack:
    """The functions; their libraries are loaded by the first call."""
    of_lapack, of_blas = _extension("_flapack", "lapack"), _extension("_fblas", "blas")
    return Lapack(
        dpstrf=of_lapack.dpstrf,
        dgerqf=of_lapack.dgerqf,
        dtzrzf=of_lapack.dtzrzf,
        dtrsm=of_blas.dtrsm,
        dtrmm=of_blas.dtrmm,
    )


def _extension(name: str, usual: str) -> Any:
    """The extension module of `scipy.linalg` with that name, or else the module that offers its functions."""
    full = f"scipy.linalg.{name}"
    if full in sys.modules:
        return sys.modules[full]
    spec = PathFinder.find_spec(full, [str(Path(scipy.__file__).parent / "linalg")])
    if spec is None or spec.loader is None:
        return getattr(scipy.linalg, usual)
    module = module_from_spec(spec)
    # The package finds it there when something else imports it.
    sys.modules[full] = module
    try:
        spec.loader.exec_module(module)
    except ImportError:
        del sys.modules[full]
        return getattr(scipy.linalg, usual)
    return module
