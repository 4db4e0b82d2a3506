"""Functions of LAPACK that are loaded without the package around them."""

import subprocess
import sys

import numpy as np
import pytest
import scipy

from pancam_graph.base import lapack


def test_they_are_those_of_scipy() -> None:
    rng = np.random.default_rng(0)
    a = rng.normal(size=(6, 6))
    for ours, theirs in (
        (lapack.dpstrf(a @ a.T), scipy.linalg.lapack.dpstrf(a @ a.T)),
        (lapack.dgerqf(a), scipy.linalg.lapack.dgerqf(a)),
        (lapack.dtzrzf(a[:3]), scipy.linalg.lapack.dtzrzf(a[:3])),
        ((lapack.dtrsm(1.0, a, a),), (scipy.linalg.blas.dtrsm(1.0, a, a),)),
        ((lapack.dtrmm(1.0, a, a),), (scipy.linalg.blas.dtrmm(1.0, a, a),)),
    ):
        for one, other in zip(ours, theirs, strict=True):
            assert np.array_equal(one, other)


@pytest.mark.parametrize("first", ["pancam_graph.base.lapack", "scipy.linalg"])
def test_they_are_loaded_once_whatever_is_imported_first(first: str) -> None:
    """And without `scipy.linalg`, where nothing else needs that."""
    code = f"""
import sys
import {first}
alone = "scipy.linalg" not in sys.modules
from pancam_graph.base import lapack
import scipy.linalg
assert lapack._LAPACK is sys.modules["scipy.linalg._flapack"] is scipy.linalg.lapack._flapack
assert lapack._BLAS is sys.modules["scipy.linalg._fblas"] is scipy.linalg.blas._fblas
print(alone)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == str(first != "scipy.linalg")
