"""Terrain in a page: the lit surface before and after, the orthoimage, and heights along a line."""

import numpy as np
from numpy.typing import NDArray

from pancam_graph.report._escaped import escape, script_json
from pancam_graph.report._numbers import Json
from pancam_graph.report._packed import HEAD, jpeg_uri, packed
from pancam_graph.report._section import section_figures
from pancam_graph.report._style import STYLE
from pancam_graph.report._terrain_script import TERRAIN_SCRIPT, UNKNOWN
from pancam_graph.terrain import Relief, ShownSurface, WrittenTerrain

__all__ = ["make_terrain_page", "terrain_section"]

_BUDGET = 3_000_000
"""Bytes that the surfaces of a page may take together; the drive is shown whatever it takes."""
_STEPS = 32_000
_PICTURES: dict[Relief, str] = {
    "refined": "lit, refined pointing",
    "telemetry": "lit, telemetry's pointing",
    "orthoimage": "as the cameras see it",
}
_LINKS = {
    "mesh": "mesh (glTF, for any viewer of 3D)",
    "dem": "heights and sigmas (GeoTIFF)",
    "dem_whole": "heights and sigmas of all distances as one (VRT)",
    "orthoimage": "orthoimage (GeoTIFF)",
    "cloud": "cloud (LAZ)",
    "cloud_ply": "cloud (PLY)",
}
_STYLE = """
.relief { margin: 0; }
.relief .stack { position: relative; width: fit-content; max-width: 100%; }
.relief img { display: block; max-width: 100%; max-height: 82vh; width: auto; height: auto; }
.relief img[hidden] { display: none; }
.relief svg { position: absolute; inset: 0; width: 100%; height: 100%; }
.relief svg { touch-action: none; cursor: crosshair; }
.relief line.halo { stroke: #ffffff; stroke-width: 5; vector-effect: non-scaling-stroke; }
.relief line.cut { stroke: #d55e00; stroke-width: 2.5; vector-effect: non-scaling-stroke; }
.relief circle { fill: #d55e00; stroke: #ffffff; stroke-width: 2; cursor: grab; }
.relief circle:focus-visible { outline: none; fill: #0072b2; }
.relief figcaption { margin: 6px 0; overflow-wrap: anywhere; }
#terrain .pair { align-items: start; }
#terrain-profile { width: 100%; height: 300px; display: block; background: var(--page);
  border: 1px solid var(--line); border-radius: 6px; }
#terrain-profile text { fill: var(--ink); font-size: 12px; }
#terrain-profile .grid { stroke: var(--line); }
#terrain-profile .band { fill: var(--after); opacity: 0.25; stroke: none; }
#terrain-profile .refined { fill: none; stroke: var(--after); stroke-width: 2; }
#terrain-profile .telemetry { fill: none; stroke: #d55e00; stroke-width: 1.5; stroke-dasharray: 5 4; }
.section { width: 100%; height: auto; display: block; border: 1px solid var(--line); border-radius: 6px; }
.section text { fill: var(--ink); font-size: 15px; }
.section .grid { stroke: var(--line); }
.section path { fill: none; stroke-width: 2; }
.section .first { stroke: var(--after); }
.section .second { stroke: #d55e00; }
#terrain a { color: var(--after); }
@media print {
  #terrain .controls { display: none; }
  #terrain .pair { display: block; }
  .relief img { max-height: 120mm; }
}
"""
_CAPTION = (
    "The surface that stereo frames see, from above, x of the world to the right and y up. Draw a line on "
    "the picture, or move its ends by the arrow keys, and its heights appear. Blink shows the surface with "
    "both pointings in turn: where frames disagree, telemetry's has steps and doubled rocks. Heights here "
    "are means over blocks of cells; the files have all cells, their sigmas, and by how much frames differ."
)


def terrain_section(written: WrittenTerrain, folder: str) -> str:
    """The section of the terrain. `folder` leads from the page to the terrain, and is empty or ends in /."""
    surfaces, left_out = _within_budget(written.surfaces)
    lines = "".join(f"<li>{escape(line)}</li>" for line in written.lines)
    options = "".join(f'<option value="{k}">{escape(s.title)}</option>' for k, s in enumerate(surfaces))
    pictures = "".join(f'<option value="{kind}">{words}</option>' for kind, words in _PICTURES.items())
    figures = "\n".join(_figure(s, folder, hidden=k > 0) for k, s in enumerate(surfaces))
    described, numbers = _described(surfaces)
    more = (
        f" {left_out} more stops are in the folder only, so that this page stays small." if left_out else ""
    )
    return (
        f'<section id="terrain">\n<style>{_STYLE}</style>\n<h2>Terrain</h2>\n<ul class="seams">{lines}</ul>\n'
        f'<div class="controls"><label>Surface <select id="terrain-surface">{options}</select></label>\n'
        f'<label>Picture <select id="terrain-picture">{pictures}</select></label>\n'
        '<button type="button" id="terrain-blink" aria-pressed="false">Blink</button></div>\n'
        f'<div class="pair"><div>{figures}</div>\n<div><svg id="terrain-profile" role="img" '
        'aria-label="Heights along the line"></svg>\n'
        '<p class="caption" id="terrain-readout" aria-live="polite"></p></div></div>\n'
        f'<p class="caption">{escape(_CAPTION + more)}</p>\n'
        f"{section_figures(written.section, written.frame_ids) if written.section is not None else ''}"
        f'<script type="application/json" id="terrain-surfaces">{script_json(described)}</script>\n'
        f'<script type="text/plain" id="packed-terrain">{packed(numbers)}</script>\n'
        f"<script>{TERRAIN_SCRIPT}</script>\n</section>\n"
    )


def make_terrain_page(written: WrittenTerrain, name: str) -> str:
    """The page of the terrain of a traverse, for its own folder."""
    head = HEAD.format(
        title=escape(f"Terrain of {name}"),
        style=STYLE,
        lead="Heights that stereo frames of the adjusted drive see, and what the adjustment gained.",
    )
    return f"{head}</header>\n<main>\n{terrain_section(written, '')}</main>\n</body>\n</html>\n"


def _within_budget(surfaces: tuple[ShownSurface, ...]) -> tuple[list[ShownSurface], int]:
    """The surfaces that a page has room for, and how many it has none for."""
    shown, taken = list[ShownSurface](), 0
    for surface in surfaces:
        taken += 4 * sum(map(len, surface.jpeg.values())) // 3 + 6 * surface.refined_m.size
        if shown and taken > _BUDGET:
            break
        shown.append(surface)
    return shown, len(surfaces) - len(shown)


def _figure(surface: ShownSurface, folder: str, *, hidden: bool) -> str:
    size = f'width="{surface.width_px}" height="{surface.height_px}"'
    images = "".join(
        f'<img data-kind="{kind}" {size} alt="{escape(surface.title)}, {words}" '
        f'src="{jpeg_uri(surface.jpeg[kind])}"'
        f"{' hidden' if kind != 'refined' else ''}>"
        for kind, words in _PICTURES.items()
        if kind in surface.jpeg
    )
    ends = "".join(
        f'<circle r="{max(surface.width_px, surface.height_px) / 90:.1f}" tabindex="0" role="button" '
        f'aria-label="{end} of the line; arrow keys move it"></circle>'
        for end in ("start", "end")
    )
    links = ", ".join(
        f'<a href="{escape(folder + surface.files[kind])}">{words}</a>'
        for kind, words in _LINKS.items()
        if kind in surface.files
    )
    return (
        f'<figure class="relief"{" hidden" if hidden else ""}><div class="stack">{images}'
        f'<svg viewBox="0 0 {surface.width_px} {surface.height_px}" preserveAspectRatio="none">'
        f'<line class="halo"></line><line class="cut"></line>{ends}</svg></div>'
        f"<figcaption>{escape(surface.title)}: {links}</figcaption></figure>"
    )


def _described(surfaces: list[ShownSurface]) -> tuple[list[Json], bytes]:
    """Where each surface lies and how its numbers are coded, and the numbers: whole steps in 16 bits."""
    described, codes, first = list[Json](), list[bytes](), 0
    for surface in surfaces:
        grid = surface.grid
        coded = [_coded(band) for band in (surface.refined_m, surface.telemetry_m, surface.sigma_m)]
        described.append(
            {
                "rows": grid.rows,
                "columns": grid.columns,
                "left": grid.left_m,
                "top": grid.top_m,
                "cell": grid.cell_m,
                "width": surface.width_px,
                "height": surface.height_px,
                "wide": surface.wide_m,
                "high": surface.high_m,
                "telemetry": "telemetry" in surface.jpeg,
                "line": _first_line(surface),
                "first": first,
                "base": [base for base, _, _ in coded],
                "step": [step for _, step, _ in coded],
            }
        )
        codes += [code for _, _, code in coded]
        first += 3 * surface.refined_m.size
    return described, b"".join(codes)


def _coded(band: NDArray[np.float32]) -> tuple[float, float, bytes]:
    """Base and step of a band, and its numbers as whole steps from there."""
    seen = np.isfinite(band)
    low, high = (float(band[seen].min()), float(band[seen].max())) if seen.any() else (0.0, 0.0)
    step = max((high - low) / _STEPS, 1e-4)
    code = np.where(seen, np.rint((np.nan_to_num(band) - low) / step), UNKNOWN)
    return low, step, code.astype("<i2").tobytes()


def _first_line(surface: ShownSurface) -> list[list[float]]:
    """The line that is shown first: along the row of cells that has most heights."""
    seen = np.isfinite(surface.refined_m)
    row = int(seen.sum(axis=1).argmax())
    columns = np.flatnonzero(seen[row])
    x, y = surface.grid.middles()
    ends = (columns[0], columns[-1]) if len(columns) else (0, surface.grid.columns - 1)
    return [[round(float(x[c]), 3), round(float(y[row]), 3)] for c in ends]
