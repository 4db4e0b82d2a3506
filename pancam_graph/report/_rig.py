"""The section of the rig: what the pictures say of cameras, mounts and the tilt axis."""

from collections.abc import Sequence

import numpy as np

from pancam_graph.data import Refined, Solution, Verdict, flex_of
from pancam_graph.report._escaped import escape
from pancam_graph.report._lens_figures import lens_figures
from pancam_graph.report._look import Figure
from pancam_graph.report._numbers import fixed, short
from pancam_graph.report._tables import table
from pancam_graph.rigs import ASPECT, FOCAL
from pancam_graph.solve import residuals_with_rig_held

__all__ = ["rig_section"]

_SIGMA = "\N{GREEK SMALL LETTER SIGMA}"
_HEAD = "What the pictures say of the camera"
_TREATMENTS = {
    "estimated": (
        "The rig is never quite what it says. Its numbers were estimated along with everything else, each "
        "within what the prior says of it."
    ),
    "held": "The rig was held: its numbers count as exact, and no sigma on this page knows of their errors.",
    "considered": (
        "The rig was considered: its numbers were not moved, but how uncertain they are is in every sigma."
    ),
}
_CAPTION = (
    f"Refined less told over the prior's {_SIGMA} is the pull; {_SIGMA} over prior {_SIGMA} is what the "
    "pictures left of the prior's uncertainty. Grey: the pictures say little, and the value is the prior's. "
    "Turns and shifts are corrections in the camera's own frame (x right, y down, z forward), of the tilt "
    "axis in its own (x forward, y left along the axis, z up)."
)
_COLUMNS = (
    ("part", "camera, mount of a camera, or tilt axis; with the stop or image where it is of one"),
    ("number", "what of it"),
    ("unit", "of all numbers in this row"),
    ("told", "as the rig has it; 0 for a correction"),
    (f"prior {_SIGMA}", "standard deviation of the prior about it"),
    ("refined", "as adjusted"),
    (f"{_SIGMA}", "formal standard deviation"),
    ("pull", "refined less told, in sigmas of the prior"),
    (f"{_SIGMA} / prior {_SIGMA}", "what the pictures left of the prior's uncertainty: 1 is all of it"),
)
_NAMES = {
    FOCAL: "focal length",
    ASPECT: "fy / fx",
    "fx_px": "focal length fx",
    "fy_px": "focal length fy",
    "skew_px": "skew",
    "cx_px": "principal point u",
    "cy_px": "principal point v",
    "radius_m": "radius of its circle",
    "pan_scale": "pan turned per pan read",
    "tilt_scale": "tilt turned per tilt read",
    **{f"r{axis}_rad": f"turn about {axis}" for axis in "xyz"},
    **{f"{axis}_m": f"shift along {axis}" for axis in "xyz"},
}
_UNITS = {"px": ("px", 1.0, 3), "rad": ("mrad", 1e3, 4), "m": ("mm", 1e3, 3)}
"""By the end of an entry's name: the unit that is shown, the factor to it from the entry's unit, decimals."""
_LITTLE = 0.9
"""Share of the prior's uncertainty from which on pictures say little of an entry."""
_BEATEN = "rig uncertainty"
"""Name of the verdict's test of the priors."""
_MOST_PULL = 3.0
"""Pull that is marked where there is no such test."""


def rig_section(solution: Solution) -> tuple[str, list[Figure]]:
    """The section as HTML, and its figures; nothing where it is not known what became of the rig."""
    if solution.treatment is None and not solution.refined:
        return "", []
    parts = [f"<p>{escape(_TREATMENTS[solution.treatment])}</p>"] if solution.treatment else []
    figures: list[Figure] = []
    if solution.refined:
        parts += [_table(solution.refined, solution), f'<p class="caption">{escape(_CAPTION)}</p>']
        parts += [f"<p>{escape(sentence)}</p>" for sentence in _beaten(solution)]
    parts += [f"<p>{escape(sentence)}</p>" for sentence in _flex(solution)]
    if solution.refined:
        for camera, panels in lens_figures(solution, residuals_with_rig_held(solution)):
            figures += panels
            parts.append(f"<h3>{escape(camera)}</h3>\n{_panels(panels)}")
    body = "\n".join(parts)
    return f'<section id="rig">\n<h2>{_HEAD}</h2>\n{body}\n</section>\n', figures


def _panels(panels: Sequence[Figure]) -> str:
    shown = "\n".join(
        f'<div><div class="plot over-image" id="{p.id}" role="group" aria-label="{escape(p.caption)}" '
        f'style="aspect-ratio: {_aspect(p)}"></div>\n<p class="caption">{escape(p.caption)}</p></div>'
        for p in panels
    )
    return f'<div class="panels">\n{shown}\n</div>'


def _aspect(panel: Figure) -> str:
    """Width to height of a panel: those of its image, with room for the axes."""
    frame = panel.layout["shapes"][0]
    width, height = frame["x1"] - frame["x0"], frame["y1"] - frame["y0"]
    return f"{1.27 * width:.0f} / {height + 0.23 * width:.0f}"


def _limit(verdict: Verdict | None) -> float:
    tests = () if verdict is None else verdict.tests
    return next((test.limit for test in tests if test.name == _BEATEN), _MOST_PULL)


def _table(refined: Sequence[Refined], solution: Solution) -> str:
    limit, rows, marks = _limit(solution.verdict), [], []
    for r in refined:
        has_prior = np.isfinite(r.prior_sigma)
        pull = r.change / r.prior_sigma if has_prior else np.nan
        left = r.sigma / r.prior_sigma if has_prior else np.nan
        unit, factor, decimals, nominal = _scale(r, solution)
        told = "differs" if nominal is None else fixed(nominal, decimals)
        change = factor * r.change
        rows.append(
            (
                _part(r),
                _NAMES.get(r.entry, r.entry),
                unit,
                told,
                fixed(factor * r.prior_sigma, decimals) if has_prior else "none",
                fixed(change + (nominal or 0.0), decimals),
                fixed(factor * r.sigma, decimals),
                fixed(pull, 2),
                fixed(left, 3 if left < _LITTLE else 2),
            )
        )
        marks.append("beaten" if abs(pull) > limit else "quiet" if left > _LITTLE else "")
    return table(_HEAD, _COLUMNS, rows, texts=3, marks=marks)


def _scale(r: Refined, solution: Solution) -> tuple[str, float, int, float | None]:
    """Unit that is shown, the factor to it from the entry's unit, decimals, and the told value in it."""
    if r.entry in {FOCAL, ASPECT}:
        rig = solution.traverse.rig
        if r.camera is None:
            return "", 1.0, 6, r.nominal
        K = rig.pinholes[rig.eye_index(r.camera)].calibration_matrix
        if r.entry == FOCAL:
            return "px", float(K[0, 0]), 3, float(K[0, 0])
        # fy / fx of a corrected camera is that of the told one times 1 + aspect, to first order.
        return "", float(K[1, 1] / K[0, 0]), 6, float(K[1, 1] / K[0, 0])
    unit, factor, decimals = _UNITS.get(r.entry.rpartition("_")[2], ("", 1.0, 6))
    return unit, factor, decimals, None if r.nominal is None else factor * r.nominal


def _part(r: Refined) -> str:
    """Part of the rig, with the stop or the image that it is of."""
    owner = r.image if r.image is not None else r.camera
    parts = {"calibration": "lens", "mounts": "mount", "pan_T_tilt": "tilt axis", "radius": "circle"}
    words = [owner, parts.get(r.quantity, r.quantity)]
    where = f" at {r.stop}" if r.stop is not None and r.image is None else ""
    return " ".join(word for word in words if word) + where


def _beaten(solution: Solution) -> list[str]:
    """What the verdict suggests where the prior of an entry is beaten."""
    tests = () if solution.verdict is None else solution.verdict.tests
    said = [test.says for test in tests if test.name == _BEATEN and test.is_note]
    return [f"{says[:1].upper()}{says[1:]}." for says in said]


def _flex(solution: Solution) -> list[str]:
    """The flex of frames in a sentence for each entry."""
    out = []
    for flex in flex_of(solution):
        unit, factor, _ = _UNITS[flex.entry.rpartition("_")[2]]
        what = (
            "turn of the head about its forward axis"
            if flex.entry == "twist_rad"
            else f"shift {flex.entry.rpartition('_')[0]}"
        )
        out.append(
            f"Flex of frames, {what}: told {short(factor * flex.sigma)} {unit}, found "
            f"{short(factor * flex.rms)} {unit} RMS, largest {short(factor * flex.largest)} {unit} in "
            f"{flex.frame}; each frame's is in solution.json."
        )
    return out
