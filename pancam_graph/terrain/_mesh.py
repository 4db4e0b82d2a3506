"""The surface as a textured mesh, its levels as one: glTF 2.0, one binary file."""

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import FloatArray
from pancam_graph.charts import encoded
from pancam_graph.terrain._fused import Fused

__all__ = ["mesh_glb", "write_mesh"]

_MAGIC, _VERSION, _JSON, _BINARY = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
_FLOAT, _UINT32, _ARRAY, _ELEMENTS = 5126, 5125, 34962, 34963
_TEXTURE_PX = 4096
_QUALITY = 90


@dataclass(frozen=True, kw_only=True, eq=False)
class _Part:
    """One level of the mesh, as the binary part of the file has it."""

    position: FloatArray
    """(n, 3) in glTF's axes."""
    blobs: tuple[bytes, bytes, bytes, bytes]
    """Positions, places in the texture, corners of triangles, and the texture."""
    corners: int


def write_mesh(fused: Fused, greys: Sequence[NDArray[np.uint8]], path: Path, most_cells: int) -> int:
    """Write the mesh of a surface with the orthoimage as its texture; returns its number of triangles."""
    content, triangles = mesh_glb(fused, greys, most_cells)
    path.write_bytes(content)
    return triangles


def mesh_glb(fused: Fused, greys: Sequence[NDArray[np.uint8]], most_cells: int) -> tuple[bytes, int]:
    """The bytes of a mesh, and its number of triangles.

    Each level of the surface is a mesh of its own, `greys` has its orthoimage; coarser ones leave out what
    finer ones cover. A vertex is the middle of a cell, or of a block of cells where there are more than
    `most_cells`; a square of four vertices that all are seen gives two triangles. glTF has y up: x is the
    world's x, y its z, z its -y, relative to the middle of the finest level, which
    `asset.extras.world_origin_m` has.
    """
    levels, parts = fused.levels, list[_Part]()
    seen = np.isfinite(fused.height_m)
    x, y = fused.grid.middles()
    origin = np.zeros(3)
    if seen.any():
        rows, columns = np.nonzero(seen)
        origin = np.array([x[columns].mean(), y[rows].mean(), fused.height_m[seen].mean()]).round(3)
    for k, (level, grey) in enumerate(zip(levels, greys, strict=True)):
        part = _part(level, levels[:k], grey, origin, most_cells)
        if part is not None:
            parts.append(part)
    views, accessors, begin = list[dict[str, int]](), list[dict[str, Any]](), 0
    for part in parts:
        first = len(views)
        for blob, target in zip(part.blobs, (_ARRAY, _ARRAY, _ELEMENTS, None), strict=True):
            view = {"buffer": 0, "byteOffset": begin, "byteLength": len(blob)}
            views.append(view | ({} if target is None else {"target": target}))
            begin += len(blob) + -len(blob) % 4
        count = len(part.position)
        accessors += [
            {
                "bufferView": first,
                "componentType": _FLOAT,
                "count": count,
                "type": "VEC3",
                "min": [float(n) for n in part.position.min(axis=0)],
                "max": [float(n) for n in part.position.max(axis=0)],
            },
            {"bufferView": first + 1, "componentType": _FLOAT, "count": count, "type": "VEC2"},
            {"bufferView": first + 2, "componentType": _UINT32, "count": part.corners, "type": "SCALAR"},
        ]
    numbers = range(len(parts))
    document: dict[str, Any] = {
        "asset": {
            "version": "2.0",
            "generator": "pancam-graph",
            "extras": {"world_origin_m": origin.tolist(), "axes": "x: world x, y: world z, z: world -y"},
        },
        "scene": 0,
        "scenes": [{"nodes": list(numbers)} if parts else {}],
    }
    if parts:
        document |= {
            "extensionsUsed": ["KHR_materials_unlit"],
            "nodes": [{"mesh": k, "name": f"terrain {k}" if k else "terrain"} for k in numbers],
            "meshes": [
                {
                    "primitives": [
                        {
                            "attributes": {"POSITION": 3 * k, "TEXCOORD_0": 3 * k + 1},
                            "indices": 3 * k + 2,
                            "material": k,
                            "mode": 4,
                        }
                    ]
                }
                for k in numbers
            ],
            "materials": [
                {
                    "pbrMetallicRoughness": {
                        "baseColorTexture": {"index": k},
                        "metallicFactor": 0.0,
                        "roughnessFactor": 1.0,
                    },
                    "extensions": {"KHR_materials_unlit": {}},
                    "doubleSided": True,
                }
                for k in numbers
            ],
            "textures": [{"source": k, "sampler": 0} for k in numbers],
            "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
            "images": [{"bufferView": 4 * k + 3, "mimeType": "image/jpeg"} for k in numbers],
            "accessors": accessors,
            "bufferViews": views,
            "buffers": [{"byteLength": begin}],
        }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(blob + b"\0" * (-len(blob) % 4) for part in parts for blob in part.blobs)
    chunk = struct.pack("<II", len(binary), _BINARY) + binary if parts else b""
    length = 12 + 8 + len(text) + len(chunk)
    head = struct.pack("<III", _MAGIC, _VERSION, length) + struct.pack("<II", len(text), _JSON)
    return head + text + chunk, sum(part.corners for part in parts) // 3


def _part(
    fused: Fused, finer: Sequence[Fused], grey: NDArray[np.uint8], origin_m: FloatArray, most_cells: int
) -> _Part | None:
    """The mesh of one level without what finer ones cover; None where nothing is left."""
    grid = fused.grid
    step = max(1, int(np.ceil(np.sqrt(grid.rows * grid.columns / most_cells))))
    x, y = grid.middles()
    height = fused.height_m[::step, ::step]
    at_x, at_y = np.meshgrid(x[::step], y[::step])
    seen, covered = np.isfinite(height), np.zeros(height.shape, dtype=bool)
    for level in finer:
        covered |= _covers(level, at_x, at_y)
    # A square stays where one corner is not covered: the levels overlap by a cell.
    whole = np.ones((max(height.shape[0] - 1, 0), max(height.shape[1] - 1, 0)), dtype=bool)
    hidden = whole.copy()
    squares = (np.s_[:-1, :-1], np.s_[1:, :-1], np.s_[:-1, 1:], np.s_[1:, 1:])
    for corner in squares:
        whole &= seen[corner]
        hidden &= covered[corner]
    whole &= ~hidden
    if not whole.any():
        return None
    used = np.zeros(height.shape, dtype=bool)
    for corner in squares:
        used[corner] |= whole
    number = np.cumsum(used).reshape(used.shape) - 1
    a, b, c, d = (number[corner][whole] for corner in squares)
    index = np.stack([a, b, c, c, b, d], axis=1).ravel().astype("<u4")
    off = np.stack([at_x[used], at_y[used], height[used].astype(float)], axis=1) - origin_m
    position = np.stack([off[:, 0], off[:, 2], -off[:, 1]], axis=1).astype("<f4")
    u = (at_x[used] - grid.left_m) / (grid.columns * grid.cell_m)
    v = (grid.top_m - at_y[used]) / (grid.rows * grid.cell_m)
    texture = np.stack([u, v], axis=1).astype("<f4")
    smaller = min(1.0, _TEXTURE_PX / max(grey.shape))
    size = max(1, round(grey.shape[1] * smaller)), max(1, round(grey.shape[0] * smaller))
    smaller_grey: NDArray[Any] = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    jpeg = encoded(smaller_grey, ".jpg", _QUALITY)
    return _Part(
        position=position,
        blobs=(position.tobytes(), texture.tobytes(), index.tobytes(), jpeg),
        corners=len(index),
    )


def _covers(fused: Fused, x_m: FloatArray, y_m: FloatArray) -> NDArray[np.bool_]:
    """Whether a surface has a height at places, arrays of one shape."""
    grid = fused.grid
    column = np.floor((x_m - grid.left_m) / grid.cell_m).astype(int)
    row = np.floor((grid.top_m - y_m) / grid.cell_m).astype(int)
    inside = (column >= 0) & (column < grid.columns) & (row >= 0) & (row < grid.rows)
    there = fused.height_m[row.clip(0, grid.rows - 1), column.clip(0, grid.columns - 1)]
    return np.asarray(inside & np.isfinite(there))
