"""The file of a smoother's state: one NumPy archive of arrays, with a header in JSON."""

import io
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.errors import InputError
from pancam_graph.base.whole_files import whole_file
from pancam_graph.data import Observations
from pancam_graph.io import (
    SharingEntry,
    TraverseFile,
    prefixed,
    read_bytes,
    short,
    traverse_entries,
    traverse_of,
    validated,
)
from pancam_graph.smoother._smoother_options import SmootherOptions
from pancam_graph.smoother._state import SmootherState

__all__ = ["load_smoother", "save_smoother"]

_FORMAT, _VERSION = "pancam-graph/smoother", 1
_ARRAYS = ("after", "fate", "track", "home", "vector", "origin_m", "key", "width", "value")
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
    """Read a state. Raises InputError for another format or version, and for a damaged file."""
    content = read_bytes(path)
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            arrays = {name: np.asarray(archive[name]) for name in archive.files}
        header = json.loads(arrays["header"].tobytes())
    except Exception as error:  # zipfile, NumPy and JSON raise many kinds
        raise InputError(f"{path}: expected a saved smoother, found a damaged or other file") from error
    if not isinstance(header, dict) or header.get("format") != _FORMAT:
        raise InputError(f"{path}: format: expected {short(_FORMAT)}, found {short(_of(header, 'format'))}")
    if header.get("version") != _VERSION:
        raise InputError(f"{path}: version: expected {_VERSION}, found {short(_of(header, 'version'))}")
    try:
        with prefixed(path):
            return _state(path, header, arrays)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: expected a whole saved smoother, found a damaged one ({error})") from error


def _of(header: object, key: str) -> object:
    return header.get(key) if isinstance(header, dict) else header


def _state(path: Path, header: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> SmootherState:
    options, sharing = header["options"], header["options"].pop("sharing")
    if sharing is not None:
        options["sharing"] = SharingEntry.model_validate(sharing).sharing()
    traverse = traverse_of(validated(TraverseFile, header["traverse"], path), path.parent)
    if "observations_image" in arrays:
        columns: dict[str, Any] = {name: arrays[f"observations_{name}"] for name in _COLUMNS[:-1]}
        columns |= {"covariance_px2": arrays.get("observations_covariance_px2")}
        columns |= {"origin": "images" if header.get("origin") == "images" else "given"}
        traverse = traverse.with_observations(Observations(**columns))
        if len(arrays["fate"]) != len(arrays["observations_image"]):
            raise ValueError("fate: another length than the observations")
    return SmootherState(
        traverse=traverse,
        options=SmootherOptions(**options),
        n_given=int(header.get("n_given", 0)),
        **{name: arrays[name] for name in _ARRAYS},
    )
