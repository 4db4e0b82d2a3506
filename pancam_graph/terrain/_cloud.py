"""Clouds of points as LAZ and as PLY."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import Site
from pancam_graph.terrain._extra import needed
from pancam_graph.terrain._make import Cloud

__all__ = ["write_cloud", "write_ply"]

_SCALE_M = 1e-4


def write_cloud(clouds: Sequence[Cloud], path: Path, crs: str, site: Site | None) -> int:
    """Write points with colour (the grey of the pictures), `sigma_m` and `frame`; returns how many.

    `frame` is the row of the frame in the traverse, `sigma_m` the standard deviation along the line of sight.
    Coordinates are whole tenths of a millimetre: of the world, or east, north and height of a site.
    """
    laspy = needed("laspy")
    needed("lazrs")
    xyz = _placed_m(clouds, site)
    grey = np.concatenate([c.points.grey for c in clouds])
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales = np.full(3, _SCALE_M)
    header.offsets = np.floor(xyz.min(axis=0)) if len(xyz) else np.zeros(3)
    header.add_extra_dim(
        laspy.ExtraBytesParams(name="sigma_m", type=np.float32, description="along the view")
    )
    header.add_extra_dim(laspy.ExtraBytesParams(name="frame", type=np.uint32, description="row of the frame"))
    header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(crs))
    header.global_encoding.wkt = True
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    for name in ("red", "green", "blue"):
        setattr(las, name, np.rint(65535 * _brightness(grey)).astype(np.uint16))
    las.sigma_m = np.concatenate([c.points.sigma_m for c in clouds]).astype(np.float32)
    las.frame = np.concatenate([c.frame for c in clouds]).astype(np.uint32)
    las.write(str(path))
    return len(xyz)


def write_ply(clouds: Sequence[Cloud], path: Path, site: Site | None) -> None:
    """Write the same points as a binary PLY file, whose coordinates have all digits."""
    grey = np.rint(255 * _brightness(np.concatenate([c.points.grey for c in clouds]))).astype(np.uint8)
    kinds = [("x", "<f8", "double"), ("y", "<f8", "double"), ("z", "<f8", "double")]
    kinds += [(name, "u1", "uchar") for name in ("red", "green", "blue")]
    kinds += [("sigma_m", "<f4", "float"), ("frame", "<u4", "uint")]
    vertex = np.empty(len(grey), dtype=[(name, kind) for name, kind, _ in kinds])
    vertex["x"], vertex["y"], vertex["z"] = _placed_m(clouds, site).T
    for name in ("red", "green", "blue"):
        vertex[name] = grey
    vertex["sigma_m"] = np.concatenate([c.points.sigma_m for c in clouds])
    vertex["frame"] = np.concatenate([c.frame for c in clouds])
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertex)}"]
    head += [f"property {word} {name}" for name, _, word in kinds]
    with path.open("wb") as file:
        file.write(("\n".join([*head, "end_header"]) + "\n").encode("ascii"))
        vertex.tofile(file)


def _placed_m(clouds: Sequence[Cloud], site: Site | None) -> FloatArray:
    """Points (n, 3) in the world; with a site metres east and north of it, and height."""
    xyz = np.concatenate([c.points.xyz_m for c in clouds])
    return xyz if site is None else xyz @ site.level_R_world.T + [0.0, 0.0, site.height_m]


def _brightness(grey: FloatArray) -> FloatArray:
    """Grey of 8 bits, or of more, from 0 to 1."""
    bright = float(grey.max()) if len(grey) else 1.0
    return np.clip(grey / (255.0 if bright <= 255 else bright), 0.0, 1.0)
