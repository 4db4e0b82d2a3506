"""Functions of LAPACK and BLAS that NumPy lacks, as SciPy has them.

`scipy.linalg` takes longer to import than a small solve takes. What it wraps are two extension modules, which
are loaded here without the package around them; from the package, where it keeps them elsewhere.
"""

import sys
from importlib.machinery import PathFinder
from importlib.util import module_from_spec
from pathlib import Path
from typing import Any

import scipy

__all__ = ["dgerqf", "dpstrf", "dtrmm", "dtrsm", "dtzrzf"]


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


_LAPACK, _BLAS = _extension("_flapack", "lapack"), _extension("_fblas", "blas")
dpstrf, dgerqf, dtzrzf = _LAPACK.dpstrf, _LAPACK.dgerqf, _LAPACK.dtzrzf
dtrsm, dtrmm = _BLAS.dtrsm, _BLAS.dtrmm
