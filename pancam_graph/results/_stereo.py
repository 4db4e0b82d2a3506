"""`stereo.npz`: covariances of places that stereo pairs see, for terrain that is made later."""

from pathlib import Path

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.regular_files import is_missing
from pancam_graph.data import StereoCovariance, Traverse
from pancam_graph.io import NpzFile, prefixed
from pancam_graph.results._output import OutputWriter, Written

__all__ = ["STEREO", "STEREO_FILE", "read_stereo"]

STEREO_FILE = "stereo.npz"
_ROUNDED = 1.001
"""What rounding may do to the square of a covariance over the product of its variances."""


def _write(written: Written, path: Path) -> Written:
    """Nothing where the solution has none of it."""
    found = written.solution.stereo_covariance
    if found is not None:
        np.savez(
            path,
            image_names=np.array([image.id for image in written.solution.traverse.images], dtype=str),
            left=found.left,
            right=found.right,
            extent=found.extent,
            depth_m=found.depth_m,
            covariance=found.covariance.astype(np.float32),
        )
    return written


STEREO = OutputWriter(write=_write)


def read_stereo(path: Path, traverse: Traverse) -> StereoCovariance | None:
    """What a `stereo.npz` says of a drive; None where there is no such file.

    Raises InputError naming file and array, what was expected and what was found: for a file of another
    drive too, and for one without all pairs of a frame.
    """
    if is_missing(path):
        return None
    file = NpzFile(path)
    n_images = len(traverse.images)
    with prefixed(path):
        names = file.array("image_names")
        if names.dtype.kind != "U" or names.tolist() != [image.id for image in traverse.images]:
            raise InputError(f"image_names: expected those of {traverse.name}, found others")
        pairs = {name: file.array(name) for name in ("left", "right")}
        numbers = {name: file.array(name) for name in ("extent", "depth_m", "covariance")}
        n = len(np.atleast_1d(pairs["left"]))
        for name, rows in pairs.items():
            if rows.shape != (n,) or rows.dtype.kind not in "iu" or np.any((rows < 0) | (rows >= n_images)):
                raise InputError(f"{name}: expected {n} rows of {n_images} images, found other numbers")
        frame = traverse.image_frame
        if np.any(frame[pairs["left"]] != frame[pairs["right"]]):
            raise InputError("left, right: expected pairs of images of one frame, found others")
        nodes = numbers["covariance"].shape[1:4]
        if numbers["covariance"].shape != (n, *nodes, 6) or len(nodes) != 3 or min(nodes, default=0) < 2:
            raise InputError(
                f"covariance: expected {n} pairs of nodes by depth, row and column, 6 entries each, found "
                f"the shape {numbers['covariance'].shape}"
            )
        for name, shape in (("extent", (n, 4)), ("depth_m", (nodes[0],))):
            if numbers[name].shape != shape:
                raise InputError(f"{name}: expected the shape {shape}, found {numbers[name].shape}")
        for name, values in numbers.items():
            if values.dtype.kind != "f" or not np.isfinite(values).all():
                raise InputError(f"{name}: expected finite numbers, found others")
        extent, depth = numbers["extent"], numbers["depth_m"]
        if np.any(np.diff(depth) <= 0) or np.any(extent[:, 1::2] <= extent[:, ::2]) or np.any(depth <= 0):
            raise InputError("extent, depth_m: expected ascending numbers, depths above 0, found others")
        c = numbers["covariance"].astype(float)
        for i, j, k in ((0, 3, 1), (0, 5, 2), (3, 5, 4)):
            if np.any(c[..., [i, j]] < 0) or np.any(c[..., k] ** 2 > _ROUNDED * c[..., i] * c[..., j]):
                raise InputError("covariance: expected covariances, found numbers that are none")
    return StereoCovariance(
        left=pairs["left"].astype(np.int64),
        right=pairs["right"].astype(np.int64),
        extent=extent.astype(float),
        depth_m=depth.astype(float),
        covariance=numbers["covariance"].astype(float),
    )
