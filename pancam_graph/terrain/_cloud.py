"""Clouds of points as LAZ."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pancam_graph.data import Site
from pancam_graph.terrain._extra import needed
from pancam_graph.terrain._make import Cloud

__all__ = ["write_cloud"]

_SCALE_M = 1e-4


def write_cloud(clouds: Sequence[Cloud], path: Path, crs: str, site: Site | None) -> int:
    """Write points with colour (the grey of the pictures), `sigma_m` and `frame`; returns how many.

    `frame` is the row of the frame in the traverse, `sigma_m` the standard deviation along the line of sight.
    Coordinates are whole tenths of a millimetre: of the world, or east, north and height of a site.
    """
    laspy = needed("laspy")
    needed("lazrs")
    xyz = np.concatenate([c.points.xyz_m for c in clouds])
    if site is not None:
        xyz = xyz @ site.level_R_world.T + [0.0, 0.0, site.height_m]
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
    bright = float(grey.max()) if len(grey) else 1.0
    full = 255.0 if bright <= 255 else bright
    for name in ("red", "green", "blue"):
        setattr(las, name, np.clip(np.rint(grey * (65535 / full)), 0, 65535).astype(np.uint16))
    las.sigma_m = np.concatenate([c.points.sigma_m for c in clouds]).astype(np.float32)
    las.frame = np.concatenate([c.frame for c in clouds]).astype(np.uint32)
    las.write(str(path))
    return len(xyz)
