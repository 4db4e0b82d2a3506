"""Functions of LAPACK that are loaded without the package around them."""

import subprocess
import sys

import numpy as np
import pytest
import scipy

from pancam_graph.base.lapack import lapack


def test_they_are_those_of_scipy() -> None:
    rng = np.random.default_rng(0)
    a = rng.normal(size=(6, 6))
    for ours, theirs in (
        (lapack().dpstrf(a @ a.T), scipy.linalg.lapack.dpstrf(a @ a.T)),
        (lapack().dgerqf(a), scipy.linalg.lapack.dgerqf(a)),
        (lapack().dtzrzf(a[:3]), scipy.linalg.lapack.dtzrzf(a[:3])),
        ((lapack().dtrsm(1.0, a, a),), (scipy.linalg.blas.dtrsm(1.0, a, a),)),
        ((lapack().dtrmm(1.0, a, a),), (scipy.linalg.blas.dtrmm(1.0, a, a),)),
    ):
        for one, other in zip(ours, theirs, strict=True):
            assert np.array_equal(one, other)


@pytest.mark.parametrize("first", ["pancam_graph.base.lapack", "scipy.linalg"])
def test_they_are_loaded_once_whatever_is_imported_first(first: str) -> None:
    """And without `scipy.linalg`, where nothing else needs that; not before they are needed."""
    code = f"""
import sys
import {first}
from pancam_graph.base.lapack import lapack
before = [name for name in sys.modules if name.startswith("scipy.linalg")]
lapack()
alone = "scipy.linalg" not in sys.modules
import scipy.linalg
assert lapack().dpstrf is scipy.linalg.lapack._flapack.dpstrf is sys.modules["scipy.linalg._flapack"].dpstrf
assert lapack().dtrsm is scipy.linalg.blas._fblas.dtrsm is sys.modules["scipy.linalg._fblas"].dtrsm
print(alone, bool(before))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    of_package = first == "scipy.linalg"
    assert done.stdout.split() == [str(not of_package), str(of_package)]
