"""Formats that have a file an image with a lens of Brown's."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.cameras import Brown
from pancam_graph.results._exported import file_names, write_export_json
from pancam_graph.results.formats._brown_lens import BrownLens, brown_lens
from pancam_graph.results.formats._source import Source

__all__ = ["write_brown_cameras"]

_WARN_PX = 0.01
"""Difference between a camera and its file that is worth a warning."""


def write_brown_cameras(
    source: Source,
    folder: Path,
    kind: str,
    suffix: str,
    text: Callable[[Source, int, Brown], str],
    *,
    skew: bool,
) -> None:
    """Write the file of each image that has a finite pose into an empty folder, and `export.json`.

    That says, of each eye, by how many pixels its file misses the camera (`brown_lens`); beyond a hundredth
    of a pixel there is a warning. Raises InputError for a camera that no lens of Brown's is near to.
    """
    solution = source.solution
    names = file_names([image.id for image in solution.traverse.images])
    lenses: dict[int, BrownLens] = {}
    listed, missed = [], dict[str, BrownLens]()
    for row in source.placed():
        camera, image = solution.image_cameras[row], solution.traverse.images[row]
        if id(camera) not in lenses:
            lenses[id(camera)] = brown_lens(camera, source.range_m(row), skew=skew)
        lens = lenses[id(camera)]
        if not np.isfinite(lens.max_px):
            raise InputError(
                f"{kind}: camera {image.camera}: expected a lens that Brown's distortion can say, "
                f"found one that folds back: take cahvor"
            )
        missed[image.camera] = lens
        file = f"{names[row]}{suffix}"
        (folder / file).write_text(text(source, row, lens.lens), encoding="utf-8", newline="\n")
        listed.append({"id": image.id, "file": file})
    worst = {name: lens for name, lens in missed.items() if lens.max_px > _WARN_PX}
    if worst:
        each = "; ".join(f"{n}: up to {b.max_px:.2g} px, RMS {b.rms_px:.2g} px" for n, b in worst.items())
        source.warnings.append(f"{kind}: files hold Brown's distortion alone, which misses {each}")
    about = {
        "frame": "world" if solution.traverse.site is None else "body",
        "cameras": [
            {"camera": name, "max_px": lens.max_px, "rms_px": lens.rms_px, "range_m": lens.range_m}
            for name, lens in missed.items()
        ],
        "images": listed,
    }
    write_export_json(folder, kind, about)
