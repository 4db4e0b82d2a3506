"""The surface as a textured mesh: glTF 2.0, one binary file."""

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pancam_graph.charts import encoded
from pancam_graph.terrain._make import Fused

__all__ = ["mesh_glb", "write_mesh"]

_MAGIC, _VERSION, _JSON, _BINARY = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
_FLOAT, _UINT32, _ARRAY, _ELEMENTS = 5126, 5125, 34962, 34963
_TEXTURE_PX = 4096
_QUALITY = 90


def write_mesh(fused: Fused, grey: NDArray[np.uint8], path: Path, most_cells: int) -> int:
    """Write the mesh of a surface with the orthoimage as its texture; returns its number of triangles."""
    content, triangles = mesh_glb(fused, grey, most_cells)
    path.write_bytes(content)
    return triangles


def mesh_glb(fused: Fused, grey: NDArray[np.uint8], most_cells: int) -> tuple[bytes, int]:
    """The bytes of a mesh, and its number of triangles.

    A vertex is the middle of a cell, or of a block of cells where there are more than `most_cells`; a square
    of four vertices that all are seen gives two triangles. glTF has y up: x is the world's x, y its z, z its
    -y, relative to the middle of the surface, which `asset.extras.world_origin_m` has.
    """
    grid = fused.grid
    step = max(1, int(np.ceil(np.sqrt(grid.rows * grid.columns / most_cells))))
    x, y = grid.middles()
    height = fused.height_m[::step, ::step]
    at_x, at_y = np.meshgrid(x[::step], y[::step])
    seen = np.isfinite(height)
    number = np.cumsum(seen).reshape(seen.shape) - 1
    whole = seen[:-1, :-1] & seen[1:, :-1] & seen[:-1, 1:] & seen[1:, 1:]
    a, b, c, d = (n[whole] for n in (number[:-1, :-1], number[1:, :-1], number[:-1, 1:], number[1:, 1:]))
    index = np.stack([a, b, c, c, b, d], axis=1).ravel().astype("<u4")
    world = np.stack([at_x[seen], at_y[seen], height[seen].astype(float)], axis=1)
    origin = world.mean(axis=0).round(3) if len(world) else np.zeros(3)
    off = world - origin
    position = np.stack([off[:, 0], off[:, 2], -off[:, 1]], axis=1).astype("<f4")
    u = (at_x[seen] - grid.left_m) / (grid.columns * grid.cell_m)
    v = (grid.top_m - at_y[seen]) / (grid.rows * grid.cell_m)
    texture = np.stack([u, v], axis=1).astype("<f4")
    smaller = min(1.0, _TEXTURE_PX / max(grey.shape))
    size = max(1, round(grey.shape[1] * smaller)), max(1, round(grey.shape[0] * smaller))
    smaller_grey: NDArray[Any] = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    jpeg = encoded(smaller_grey, ".jpg", _QUALITY)
    parts = [position.tobytes(), texture.tobytes(), index.tobytes(), jpeg]
    views, begin = [], 0
    for part, target in zip(parts, (_ARRAY, _ARRAY, _ELEMENTS, None), strict=True):
        view: dict[str, int] = {"buffer": 0, "byteOffset": begin, "byteLength": len(part)}
        views.append(view | ({} if target is None else {"target": target}))
        begin += len(part) + -len(part) % 4
    accessors = [
        {
            "bufferView": 0,
            "componentType": _FLOAT,
            "count": len(position),
            "type": "VEC3",
            "min": [float(n) for n in position.min(axis=0)],
            "max": [float(n) for n in position.max(axis=0)],
        },
        {"bufferView": 1, "componentType": _FLOAT, "count": len(texture), "type": "VEC2"},
        {"bufferView": 2, "componentType": _UINT32, "count": len(index), "type": "SCALAR"},
    ]
    document = {
        "asset": {
            "version": "2.0",
            "generator": "pancam-graph",
            "extras": {"world_origin_m": origin.tolist(), "axes": "x: world x, y: world z, z: world -y"},
        },
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "terrain"}],
        "meshes": [
            {
                "primitives": [
                    {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0, "mode": 4}
                ]
            }
        ],
        "materials": [
            {
                "pbrMetallicRoughness": {
                    "baseColorTexture": {"index": 0},
                    "metallicFactor": 0.0,
                    "roughnessFactor": 1.0,
                },
                "extensions": {"KHR_materials_unlit": {}},
                "doubleSided": True,
            }
        ],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
        "images": [{"bufferView": 3, "mimeType": "image/jpeg"}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": begin}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(part + b"\0" * (-len(part) % 4) for part in parts)
    length = 12 + 8 + len(text) + 8 + len(binary)
    head = struct.pack("<III", _MAGIC, _VERSION, length) + struct.pack("<II", len(text), _JSON)
    return head + text + struct.pack("<II", len(binary), _BINARY) + binary, len(index) // 3
