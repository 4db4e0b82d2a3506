"""The file of a smoother's state: one NumPy archive of arrays, with a header in JSON."""

import io
import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pancam_graph.base.arrays import float_array, int_array
from pancam_graph.base.errors import InputError
from pancam_graph.base.whole_files import whole_file
from pancam_graph.data import Observations
from pancam_graph.io import (
    Entry,
    NpzFile,
    SharingEntry,
    TraverseFile,
    json_object,
    prefixed,
    traverse_entries,
    traverse_of,
    validated,
)
from pancam_graph.smoother._smoother_options import SmootherOptions
from pancam_graph.smoother._state import SmootherState

__all__ = ["load_smoother", "save_smoother"]

_FORMAT, _VERSION = "pancam-graph/smoother", 1
_ARRAYS: dict[str, Callable[[str, Any], NDArray[Any]]] = {
    **dict.fromkeys(("after", "fate", "track", "home"), int_array),
    **dict.fromkeys(("vector", "origin_m"), float_array),
    **dict.fromkeys(("key", "width"), int_array),
    "value": float_array,
}
"""Arrays of a state, in the order of the file, and what each is turned into."""
_COLUMNS = ("image", "track", "uv_px", "sigma_px", "covariance_px2")


def save_smoother(state: SmootherState, path: Path) -> None:
    """Write a state, whole or not at all. Raises InputError where the file cannot be written."""
    options = asdict(replace(state.options, sharing=None))
    sharing = state.options.sharing
    options["sharing"] = (
        None if sharing is None else SharingEntry.of(sharing).model_dump(exclude_defaults=True)
    )
    header = {
        "format": _FORMAT,
        "version": _VERSION,
        "options": options,
        "n_given": state.n_given,
        "origin": "given" if state.traverse.observations is None else state.traverse.observations.origin,
        "traverse": traverse_entries(state.traverse).model_dump(exclude={"sharing"}),
    }
    text = json.dumps(header, allow_nan=False, ensure_ascii=False).encode()
    arrays: dict[str, NDArray[Any]] = {"header": np.frombuffer(text, dtype=np.uint8)}
    arrays |= {name: getattr(state, name) for name in _ARRAYS}
    if state.traverse.observations is not None:
        columns = {name: getattr(state.traverse.observations, name) for name in _COLUMNS}
        arrays |= {f"observations_{name}": c for name, c in columns.items() if c is not None}
    content = io.BytesIO()
    savez: Any = np.savez  # its stub takes every keyword for the flag allow_pickle
    savez(content, **arrays)
    try:
        whole_file(path, content.getvalue())
    except OSError as error:
        raise InputError(f"{path}: expected a file to write to, found: {error}") from error


def load_smoother(path: Path) -> SmootherState:
    """Read a state. Raises InputError naming file and entry for another format or version, or a damaged file.

    Types and shapes are checked here; that entries fit together, by `TraverseSmoother.of`.
    """
    archive = NpzFile(path)
    with prefixed(path):
        text = archive.array("header").tobytes()
    entries = validated(_Header, json_object(text, path, _FORMAT, _VERSION), path)
    with prefixed(path):
        return _state(entries, archive, path.parent)


class _Options(Entry):
    """`SmootherOptions`, entry by entry."""

    telemetry: Literal["absolute", "odometry"]
    rig: Literal["estimated", "held"] = "held"
    """Older files do not say: with these the rig was held."""
    sharing: SharingEntry | None
    relinearise_rad: float
    relinearise_m: float
    relinearise_rig: float
    outlier_sigma: float | None
    closure_probability: float
    max_rounds: int

    def options(self) -> SmootherOptions:
        """The options. Raises InputError for one that is out of its range."""
        values = {name: getattr(self, name) for name in type(self).model_fields}
        sharing = None if self.sharing is None else self.sharing.sharing()
        return SmootherOptions(**{**values, "sharing": sharing})


class _Header(Entry):
    """The file's JSON."""

    format: Literal["pancam-graph/smoother"]
    version: Literal[1]
    options: _Options
    n_given: Annotated[int, Field(ge=0)] = 0
    origin: Literal["given", "images"] = "given"
    traverse: TraverseFile


def _state(header: _Header, archive: NpzFile, folder: Path) -> SmootherState:
    with prefixed("options"):
        options = header.options.options()
    with prefixed("traverse"), np.errstate(all="ignore"):  # numbers that overflow are refused as such
        traverse = traverse_of(header.traverse, folder)
    if "observations_image" in archive.names:
        columns: dict[str, Any] = {name: archive.array(f"observations_{name}") for name in _COLUMNS[:-1]}
        columns["origin"] = header.origin
        if "observations_covariance_px2" in archive.names:
            columns["covariance_px2"] = archive.array("observations_covariance_px2")
        with np.errstate(all="ignore"):
            traverse = traverse.with_observations(Observations(**columns))
    arrays: dict[str, Any] = {name: turned(name, archive.array(name)) for name, turned in _ARRAYS.items()}
    return SmootherState(traverse=traverse, options=options, n_given=header.n_given, **arrays)
