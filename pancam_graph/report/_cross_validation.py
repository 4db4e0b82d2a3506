"""The section of a cross-validation: formal and honest sigmas, and how halves fit each other."""

from collections.abc import Iterator

import numpy as np

from pancam_graph.data import CrossValidation, Sigmas, Traverse
from pancam_graph.report._escaped import escape
from pancam_graph.report._numbers import fixed
from pancam_graph.report._tables import table

__all__ = ["cross_validation_section"]

_SIGMA = "\N{GREEK SMALL LETTER SIGMA}"
_MEANING = (
    "A check of the formal sigmas, no cure for them: where the rig was estimated they should hold, and "
    "the ratios be near 1. Halves of the points were solved alone, and where two halves differ by more "
    "than noise explains, the honest sigma is larger: halves drawn by lot show noise that is larger "
    "than was thought, upper and lower image halves also errors of lenses that no number of the rig "
    "describes, and of a rig that was held."
)
_CAPTION = (
    "All in mrad and mm. Relative angles are those of the second frame less those of the first, "
    "for neighbours that share points; the axes of a stop are its mast's. If noise is all there is, the "
    "four sigmas agree but for chance. What telemetry holds is left out; a dash: no half can tell."
)
_SCORE_CAPTION = (
    "RMS residuals of the points of one half, seen through its own cameras, and placed anew through the "
    "cameras of the other half, which never saw them. Scored are points of which the other half sees all "
    "frames."
)


def cross_validation_section(validation: CrossValidation | None, traverse: Traverse) -> str:
    """The section as HTML; nothing without a cross-validation."""
    if validation is None:
        return ""
    warnings = "".join(f"<li>{escape(w)}</li>" for w in validation.warnings)
    notes = f'<ul class="notes">{warnings}</ul>\n' if warnings else ""
    return (
        "<section>\n<h2>Cross-validation</h2>\n"
        f"<p>{escape(_MEANING)}</p>\n{notes}{_sigma_table(validation, traverse)}\n"
        f'<p class="caption">{escape(_CAPTION)}</p>\n{_score_table(validation)}\n'
        f'<p class="caption">{escape(_SCORE_CAPTION)}</p>\n</section>'
    )


def _sigma_table(validation: CrossValidation, traverse: Traverse) -> str:
    columns = (
        ("quantity", "what the sigmas are of"),
        ("of", "ids of the frames or of the stop"),
        ("unit", "unit of the sigmas"),
        (f"formal {_SIGMA}", "from the noise assumed and the geometry"),
        ("random halves", "sigma that solutions from halves of the points, drawn by lot, speak for"),
        ("upper / lower", "sigma that solutions from the upper and the lower image halves speak for"),
        (f"honest {_SIGMA}", "the largest of the three"),
        ("honest / formal", "how much larger the honest sigma is"),
        ("upper to lower", "size of the difference between the solutions of the upper and the lower halves"),
    )
    ids = [f.id for f in traverse.frames]
    pairs = [f"{ids[i]} → {ids[j]}" for i, j in validation.pairs.tolist()]
    axes = ("roll", "pitch", "heading", "position x", "position y", "position z")
    rows = [
        *_rows(("relative pan", "relative tilt"), ("mrad",) * 2, pairs, validation.relative_pointing),
        *_rows(("pan", "tilt"), ("mrad",) * 2, ids, validation.pointing),
        *_rows(axes, ("mrad",) * 3 + ("mm",) * 3, [s.id for s in traverse.stops], validation.stops),
    ]
    return table("Formal and honest sigmas", columns, rows, texts=3)


def _rows(
    kinds: tuple[str, ...], units: tuple[str, ...], names: list[str], sigmas: Sigmas
) -> Iterator[tuple[str, ...]]:
    numbers = np.stack(
        [
            sigmas.formal,
            sigmas.random.sigma,
            sigmas.upper_lower.sigma,
            sigmas.honest,
            sigmas.upper_lower.difference,
        ],
        axis=-1,
    )
    for i, name in enumerate(names):
        for k, (kind, unit) in enumerate(zip(kinds, units, strict=True)):
            if sigmas.formal[i, k] == 0:
                continue
            *cells, apart = (fixed(1e3 * number, 4) for number in numbers[i, k])
            yield kind, name, unit, *cells, fixed(sigmas.ratio[i, k], 1), apart


def _score_table(validation: CrossValidation) -> str:
    columns = (
        ("half", "which half of the points"),
        ("points", "points of this half"),
        ("scored", "points of which the other half sees all frames"),
        ("own cameras (px)", "RMS residual with the cameras of the half's own solution"),
        ("noise alone (px)", "what that would be if noise were all there is"),
        ("other half's cameras (px)", "RMS residual with the cameras that the other half gave"),
        ("noise alone (px) ", "what that would be if noise were all there is"),
    )
    rows = [
        (
            f"{s.half}, by lot {s.halving + 1}" if s.splitting == "random" else s.half,
            f"{s.tracks}",
            f"{s.scored}",
            *(fixed(n, 3) for n in (s.own_px, s.own_expected_px, s.other_px, s.other_expected_px)),
        )
        for s in validation.scores
    ]
    return table("Halves scored by each other", columns, rows, texts=1)
