"""The formats of other programs. To add one: a module with its writer, and an entry here.

Listing names imports no writer.
"""

# Each writer is imported when it is first used, so that `--help` does not wait for OpenCV.
# ruff: noqa: PLC0415

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pancam_graph.base.choices import expected_one_of
from pancam_graph.base.errors import InputError

if TYPE_CHECKING:
    from pancam_graph.results.formats import Source

__all__ = ["DOORS", "Door", "door_of"]

Writer = Callable[["Source", Path], None]


@dataclass(frozen=True, kw_only=True)
class Door:
    """A format of another program."""

    name: str
    """What `--to` calls it."""
    says: str
    """What it is, as help says it."""
    writer: Callable[[], Writer]
    """Imports and returns the function that writes it at a path: a file, or an empty folder."""
    is_folder: bool = True
    endings: tuple[str, ...] = ()
    """Endings of a file that stand for it."""


def _colmap() -> Writer:
    from pancam_graph.results._brightness import brightness_of
    from pancam_graph.results._colmap import fill_colmap

    return lambda source, folder: fill_colmap(source.solution, folder, brightness_of(source.solution))


def _cahvor() -> Writer:
    from pancam_graph.results.formats._cahvor import write_cahvor

    return write_cahvor


def _tsai() -> Writer:
    from pancam_graph.results.formats._tsai import write_tsai

    return write_tsai


def _csm() -> Writer:
    from pancam_graph.results.formats._csm import write_csm

    return write_csm


def _bundler() -> Writer:
    from pancam_graph.results.formats._bundler import write_bundler

    return write_bundler


def _nvm() -> Writer:
    from pancam_graph.results.formats._nvm import write_nvm

    return write_nvm


def _tpt() -> Writer:
    from pancam_graph.results.formats._tpt import write_tpt

    return write_tpt


def _tpt_text() -> Writer:
    from pancam_graph.results.formats._tpt import write_tpt_text

    return write_tpt_text


def _nav() -> Writer:
    from pancam_graph.results.formats._nav import write_nav

    return write_nav


def _nav_text() -> Writer:
    from pancam_graph.results.formats._nav import write_nav_text

    return write_nav_text


def _rvf() -> Writer:
    from pancam_graph.results.formats._rvf import write_rvf

    return write_rvf


def _vector() -> Writer:
    from pancam_graph.results.formats._vector import write_vector

    return write_vector


def _network() -> Writer:
    from pancam_graph.results.formats._network import write_network

    return write_network


def _tables() -> Writer:
    from pancam_graph.results.formats._tables import write_tables

    return write_tables


def _parquet() -> Writer:
    from pancam_graph.results.formats._tables import write_parquet

    return write_parquet


def _traverse() -> Writer:
    from pancam_graph.results.formats._traverse import write_drive

    return write_drive


_ALL = (
    Door(
        name="nav",
        says="pointing corrections of marsnav, XML",
        writer=_nav,
        is_folder=False,
        endings=(".nav",),
    ),
    Door(name="nav-text", says="the same as text", writer=_nav_text, is_folder=False),
    Door(name="tpt", says="tie points of marsnav, XML", writer=_tpt, is_folder=False, endings=(".tpt",)),
    Door(name="tpt-text", says="the same as the older text", writer=_tpt_text, is_folder=False),
    Door(
        name="rvf",
        says="poses of the rover in its site, XML of VICAR",
        writer=_rvf,
        is_folder=False,
        endings=(".rvf",),
    ),
    Door(name="vector", says="tracks and cameras for VECTOR", writer=_vector),
    Door(name="colmap", says="COLMAP model with undistorted images", writer=_colmap),
    Door(name="cahvor", says="camera of each image as JPL's tools print it", writer=_cahvor),
    Door(name="tsai", says="pinhole of each image for the Ames Stereo Pipeline", writer=_tsai),
    Door(name="csm", says="CSM Frame state of each image for ISIS and the Ames Stereo Pipeline", writer=_csm),
    Door(name="bundler", says="bundle.out with undistorted images", writer=_bundler),
    Door(name="nvm", says="scene.nvm of VisualSFM with undistorted images", writer=_nvm),
    Door(
        name="control-network",
        says="ISIS control network as CSV",
        writer=_network,
        is_folder=False,
        endings=(".csv",),
    ),
    Door(name="tables", says="tables of all results with sigmas, CSV", writer=_tables),
    Door(name="parquet", says="the same as Parquet", writer=_parquet),
    Door(name="traverse", says="a drive that refine reads", writer=_traverse),
)
DOORS = {door.name: door for door in _ALL}
"""The formats by name, in the order of help."""


def door_of(out: Path, to: str | None) -> Door:
    """The format that is asked for, or that the ending of a path says. Raises InputError for none."""
    if to is not None:
        if to not in DOORS:
            raise InputError(expected_one_of("to", to, list(DOORS)))
        return DOORS[to]
    ending = out.suffix.lower()
    found = next((door for door in _ALL if ending in door.endings), None)
    if found is None:
        endings = ", ".join(ending for door in _ALL for ending in door.endings)
        raise InputError(
            f"{out}: expected a file that ends in one of {endings}, or a format told by --to "
            f"({', '.join(DOORS)}), found neither"
        )
    return found
