"""Where a rover is on its planet: a table of localisation as the missions' archives have them (PLACES, CSV).

A row gives a rover, or the origin of a site frame, by its site and drive: latitude, longitude and elevation.
Columns, in any case of letters: `frame` (`ROVER`, `SITE`), `site`, `drive`, `pose` (may be missing),
`planetocentric_latitude` or `planetodetic_latitude`, `longitude`, `elevation`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import Site
from pancam_graph.io._csv_table import CsvTable, read_csv_table
from pancam_graph.io._json import prefixed
from pancam_graph.io._told_numbers import told_number

__all__ = ["Localised", "is_places", "site_by_places"]

_NEEDED = ("frame", "site", "drive", "longitude", "elevation")
_CENTRIC, _DETIC = "planetocentric_latitude", "planetodetic_latitude"
_HEAD_BYTES = 4096
_APART_M = 2.0
"""Distance of a stop's place in the table from that of its label above which a warning says so."""


@dataclass(frozen=True, kw_only=True)
class Localised:
    """The site of a drive, and what is to be said of it."""

    site: Site
    warnings: tuple[str, ...]


def is_places(file: Path) -> bool:
    """Whether a file is a CSV whose first line has the columns of a table of localisation."""
    if file.suffix.lower() != ".csv" or not file.is_file():
        return False
    with file.open("rb") as stream:
        head = stream.read(_HEAD_BYTES).split(b"\n", 1)[0].decode("utf-8-sig", "replace").lower()
    names = {name.strip().strip('"') for name in head.split(",")}
    return names.issuperset(_NEEDED) and bool(names & {_CENTRIC, _DETIC})


def site_by_places(
    file: Path, first_site: int, rovers: Mapping[tuple[int, int], FloatArray]
) -> Localised | None:
    """The site of a Mars rover's drive whose world is the frame of a site, turned to z up: x is north.

    `rovers` are places (3,) of the rover in the world, by site and drive. Where the table has the origin of
    the site frame, the world's origin is there; else it is placed by the first of the rovers that the table
    has; None where it has none. Raises InputError naming file and line for what is no number.
    """
    table = read_csv_table(file)
    with prefixed(file):
        rows = _rows(table)
        origin = rows.get(("SITE", first_site, None))
        known = {place: rows["ROVER", *place] for place in rovers if ("ROVER", *place) in rows}
        if origin is not None:
            site = _site(origin)
        elif known:
            place, row = next(iter(sorted(known.items())))
            here = _site(row)
            ((latitude, longitude, height),) = here.geographic(-rovers[place][None])
            site = Site(
                body="Mars", latitude_deg=latitude, longitude_deg=longitude, height_m=height, north_rad=0.0
            )
        else:
            return None
    warnings = []
    if known:
        told = np.array([rovers[place] for place in known])
        found = site.points_m(np.array([_geographic(row) for row in known.values()]))
        off = np.linalg.norm((found - told)[:, :2], axis=1)
        if off.max() > _APART_M:
            worst = list(known)[int(np.argmax(off))]
            warnings.append(
                f"{file.name}: places of stops differ by up to {off.max():.1f} m from those of their labels "
                f"(site {worst[0]}, drive {worst[1]}); latitudes and longitudes follow the labels"
            )
    return Localised(site=site, warnings=tuple(warnings))


def _rows(table: CsvTable) -> dict[tuple[str, int, int | None], Sequence[float]]:
    """Latitude, whether it is planetodetic, longitude and elevation, by frame, site and drive.

    The last pose of a place counts; a site's frame has no drive.
    """
    header = [name.lower() for name in table.header]
    at = {
        name: header.index(name) for name in (*_NEEDED, *((_CENTRIC,) if _CENTRIC in header else (_DETIC,)))
    }
    latitude = _CENTRIC if _CENTRIC in at else _DETIC
    out: dict[tuple[str, int, int | None], Sequence[float]] = {}
    for line, cells in table.rows:
        frame = cells[at["frame"]].strip().strip("'\"").upper()
        if frame not in {"ROVER", "SITE"}:
            continue
        site, drive = (_number(cells[at[name]], line, name) for name in ("site", "drive"))
        numbers = [_number(cells[at[name]], line, name) for name in (latitude, "longitude", "elevation")]
        key = (frame, int(site), int(drive) if frame == "ROVER" else None)
        out[key] = (numbers[0], float(latitude == _DETIC), *numbers[1:])
    return out


def _number(cell: str, line: int, name: str) -> float:
    number = told_number(cell.strip())
    if number is None or not np.isfinite(number):
        raise InputError(f"line {line}: {name}: expected a number, found {cell[:60]!r}")
    return float(number)


def _geographic(row: Sequence[float]) -> tuple[float, float, float]:
    """Planetocentric latitude, longitude and elevation of a row."""
    latitude, is_detic, longitude, elevation = row
    if is_detic:
        # On the ellipsoid; of points some kilometres beside it, by less than a hundredth of an arc second.
        probe = Site(body="Mars", latitude_deg=0.0, longitude_deg=0.0, height_m=0.0, north_rad=0.0).shape
        phi = np.radians(latitude)
        radius = probe.equator_m / np.sqrt(1 - probe.e2 * np.sin(phi) ** 2)
        z, across = (radius * (1 - probe.e2) + elevation) * np.sin(phi), (radius + elevation) * np.cos(phi)
        latitude = float(np.degrees(np.arctan2(z, across)))
    return latitude, longitude, elevation


def _site(row: Sequence[float]) -> Site:
    latitude, longitude, elevation = _geographic(row)
    return Site(
        body="Mars", latitude_deg=latitude, longitude_deg=longitude, height_m=elevation, north_rad=0.0
    )
