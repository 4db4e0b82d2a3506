"""VECTOR, JPL's viewer of bundle adjustments: `tracks.xml` and `cameras.xml`.

Source: its own converter of marsnav's files, and its parser, which takes CAHVORE cameras alone: a CAHVOR is a
perspective CAHVORE whose pupil does not move, a CAHV one without distortion.
"""

from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from pancam_graph.cameras import CAHV, CAHVOR, CAHVORE
from pancam_graph.results._exported import write_export_json
from pancam_graph.results.formats._source import Source
from pancam_graph.results.formats._tpt import tie_file
from pancam_graph.results.formats._vicar import pairs_of_tracks, site_xyz, told_and_found

__all__ = ["write_vector"]


def write_vector(source: Source, folder: Path) -> None:
    """Write `tracks.xml` and `cameras.xml` into an empty folder.

    Of a track are written the observations in use; images whose camera has no equal in the CAHV family are
    named in a warning and left out.
    """
    (folder / "tracks.xml").write_text(_tracks(source), encoding="utf-8", newline="\n")
    (folder / "cameras.xml").write_text(_cameras(source), encoding="utf-8", newline="\n")
    write_export_json(folder, "vector", {})


def _tracks(source: Source) -> str:
    solution = source.solution
    observations = solution.traverse.observations
    first = {tie.track: tie.adjusted for tie in reversed(tie_file(source).ties) if tie.adjusted is not None}
    lines = ['<vector version="1.0" format="track" reference_frame="SITE_FRAME">']
    number = 0
    for track, rows in pairs_of_tracks(source):
        landmark = int(solution.landmark_row[rows[0]])
        assert observations is not None  # there are rows
        if landmark < 0 or track not in first:
            continue
        final = site_xyz(solution.final.landmarks_m[landmark])
        lines.append(f'  <track id="{track}">')
        lines.append(f"    <initial_xyz{_xyz(np.array(first[track].init_xyz))}/>")
        lines += [f"    <final_xyz{_xyz(final)}/>", "    <points>"]
        for row in rows.tolist():
            who = source.identities[int(observations.image[row])]
            lines.append(f'      <point id="{number}" camera_id={quoteattr(who.unique_id)}>')
            lines.append(f"        <pixel{_xy(observations.uv_px[row])}/>")
            lines.append(f"        <initial_residual{_xy(solution.residual_initial_px[row])}/>")
            lines.append(f"        <final_residual{_xy(solution.residual_final_px[row])}/>")
            lines.append("      </point>")
            number += 1
        lines += ["    </points>", "  </track>"]
    return "\n".join([*lines, "</vector>", ""])


def _cameras(source: Source) -> str:
    frame = "ROVER_FRAME" if source.solution.traverse.rig.rover_T_mast is not None else "SITE_FRAME"
    lines = [f'<vector version="1.0" format="camera" reference_frame="{frame}">']
    without = 0
    for row, who in enumerate(source.identities):
        models = told_and_found(source, row)
        if models is None:
            without += 1
            continue
        name = source.solution.traverse.images[row].file or who.image_id
        lines.append(
            f'  <camera id={quoteattr(who.unique_id)} image={quoteattr(Path(name).name)} model="CAHVORE">'
        )
        for when, model in zip(("initial", "final"), models, strict=True):
            lines.append(f"    <{when}>")
            lines += [f'      <parameter id="{n}"{_xyz(v)}/>' for n, v in _vectors(model).items()]
            kind, parameter = (3, model.linearity) if isinstance(model, CAHVORE) else (1, 1.0)
            lines += [f'      <parameter id="T" v="{kind}"/>', f'      <parameter id="P" v="{parameter!r}"/>']
            lines.append(f"    </{when}>")
        lines.append("  </camera>")
    if without:
        source.warnings.append(f"vector: {without} cameras have no equal in the CAHV family and are left out")
    return "\n".join([*lines, "</vector>", ""])


def _vectors(model: CAHV) -> dict[str, np.ndarray]:
    """The vectors of a CAHVORE that is the equal of a model of the family."""
    zero = np.zeros(3)
    out = {name: getattr(model, name) for name in "CAHV"}
    out |= {"O": model.O, "R": model.R} if isinstance(model, CAHVOR) else {"O": model.A, "R": zero}
    return out | {"E": model.E if isinstance(model, CAHVORE) else zero}


def _xyz(values: np.ndarray) -> str:
    return "".join(f' {axis}="{value!r}"' for axis, value in zip("xyz", values.tolist(), strict=True))


def _xy(values: np.ndarray) -> str:
    return "".join(f' {axis}="{value!r}"' for axis, value in zip("xy", values.tolist(), strict=True))
