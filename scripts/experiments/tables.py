"""The page results.md: methods, expectations, tables."""

from collections.abc import Sequence

from experiments.alternation import STEPS
from experiments.opportunity import NAME as OPPORTUNITY
from experiments.running import Row, Sample
from experiments.verdicts import Results, Verdict, number

__all__ = ["results_text"]

_METRICS = {
    "cost_relative": "cost, relative",
    "angle_rad": "angles (rad)",
    "stop_m": "second stop (m)",
    "landmark_relative": "landmarks, relative",
    "centre_mm": "centres (mm)",
    "centre_predicted_mm": "centres, as predicted (mm)",
    "centre_within_mm": "centres within a cluster (mm)",
    "rotation_mrad": "rotations (mrad)",
    "landmark_m": "landmarks (m)",
    "landmark_median_m": "their median (m)",
    "landmark_near_m": "near ones (m)",
    "landmark_far_m": "far ones (m)",
    "focal_percent": "focal length (%)",
    "distance_aligned_percent": "distances, aligned (%)",
    "distance_percent": "distances (%)",
    "distance_predicted_percent": "distances, as predicted (%)",
    "localisation_percent": "last stop (% of the way)",
    "reprojection_px": "residual (px)",
    **{f"excess_after_{n}_steps": f"cost above the best after {n} steps, relative" for n in STEPS},
    "iterations": "iterations",
}
"""Columns of the tables. All metrics are in results.json."""

_HOW = """\
The experiments follow the table of contents of C. Albl's thesis *PanCam Bundle Adjustment* (chapter 5);
the thesis's own figures have not survived, so there is nothing to compare with, only the same questions.

## How

- **Scene.** MER's Navcam (45 degrees, 1222 px), left eye 0.14 m from the pan axis, on rolling ground
  with rocks. A cluster has 18 images 20 degrees apart: one eye all around, or both eyes over half a turn
  (so that neighbours overlap alike). Neighbouring centres are 5 cm apart. Points up to 20 m away are
  matched, 25 are looked for in each image: most are seen by two frames, and only the strip that three
  see joins the depths of one pair to the next's. So a one-eye cluster of free cameras can be solved, but
  weakly. Stops are 8 m apart unless named otherwise.
- **Same for all models:** observations (no outliers, loss none), their sigmas, start, telemetry of the
  rig. Encoders are wrong by 1.3 mrad, odometry by 6 % of the spacing in each component and 0.03 rad.
- **Priors, so that telemetry does not do the images' work:** pan has a sigma of 20 mrad with all models,
  tilt that of its encoder (the model `circle` takes the circle's height from it). Cameras of `free` are tied
  to the mast by 20 mrad and 0.3 m, twice the radius of the circle. Stops have the sigma of their odometry;
  the first is held. So the scale of `free` cameras is that of odometry, for no image tells it.
  `projective` is tied like `free`, each of the five numbers of its calibrations by 5 % of the focal length.
- **Sharing:** with the rig that the simulation had, nothing is free but the radii of `circle` and the
  calibrations of `projective`, one for each image. Where the rig is "not quite known", solvers are told
  focal lengths with errors of 0.3 % and mounts with errors of 5 mrad and 2 mm. "Fixed" believes that;
  "shared" frees one focal length, mount (`mast`) and radius (`circle`) per eye; "unshared" a focal length
  for each image, a mount and a radius for each stop. Priors are the package's.
- **Errors:** a similarity (Umeyama) is estimated from the camera centres to the true ones, and applied to
  centres and landmarks. Rotations are aligned by their own mean. "Distances, aligned" are those between the
  clusters (means of their centres) after the similarity, "distances" before it: the scale is the solution's
  own. "Last stop" is its error after the first stop's cameras were laid on the true ones without scaling, in
  % of the way driven. Landmarks are near within 5 m of a mast.
- **As predicted:** the same errors of draws from the solution's own covariance about it (median of 25), so
  what the information allows. "Within a cluster": each cluster's centres after a similarity of their own.
- **Failed:** the solve raised an error, did not converge within 200 steps, or lost an observation's landmark.
  A failed run is infinitely wrong in every metric and stays in the median and the interval (∞; null in
  results.json). Points beyond infinity are no failure; they count where they lie, which makes RMS errors
  huge.
- Quantiles are by rank: median (5 % to 95 %).
"""


def results_text(
    rows: Sequence[Row],
    samples: Sequence[Sample],
    judged: Sequence[Verdict],
    left_out: Sequence[str],
    figures: Sequence[str],
) -> str:
    """Text of results.md."""
    results = Results(rows)
    parts = ["# Experiments of the thesis", _HOW, "## Expected and found", *map(_verdict, judged)]
    if left_out:
        parts.append("## Left out\n\n" + "\n".join(f"- {sentence}." for sentence in left_out))
    failures = _failures(samples)
    if failures:
        parts.append("## Failed runs\n\n" + failures)
    parts += [f"![{name}]({name}.png)" for name in figures]
    for experiment in dict.fromkeys(r.experiment for r in rows):
        parts.append(f"## {experiment[0].upper()}{experiment[1:]}")
        parts.append(_real(results) if experiment == OPPORTUNITY else _simulated(results, experiment))
    return "\n\n".join(part.strip() for part in parts) + "\n"


def _verdict(verdict: Verdict) -> str:
    lines = [f"**{verdict.expectation}: {'holds' if verdict.holds else 'does not hold everywhere'}.**", ""]
    lines += [f"- {'holds' if ok else 'does not hold'}: {text}" for text, ok in verdict.figures]
    if not verdict.holds and verdict.explanation:
        lines += ["", verdict.explanation]
    return "\n".join(lines)


def _failures(samples: Sequence[Sample]) -> str:
    """How many runs failed, and the first reason, by experiment, model and noise."""
    groups: dict[tuple[str, str, str, float | None], list[Sample]] = {}
    for s in samples:
        groups.setdefault((s.experiment, s.model, s.sharing, s.noise_px), []).append(s)
    rows = []
    for (experiment, model, sharing, noise_px), group in groups.items():
        failed = [s for s in group if s.failure]
        if failed:
            noise = "" if noise_px is None else f"{noise_px:g}"
            rows.append(
                [experiment, model, sharing, noise, f"{len(failed)} of {len(group)}", failed[0].failure]
            )
    return (
        _table(["experiment", "model", "sharing", "noise (px)", "failed", "the first because"], rows)
        if rows
        else ""
    )


def _simulated(results: Results, experiment: str) -> str:
    rows = [r for r in results.rows if r.experiment == experiment]
    names = [m for m in _METRICS if any(r.metric == m for r in rows)]
    by = {(r.noise_px, r.model, r.sharing, r.metric): r for r in rows}
    lines = []
    for noise_px, model, sharing in dict.fromkeys((r.noise_px, r.model, r.sharing) for r in rows):
        cells = [by.get((noise_px, model, sharing, m)) for m in names]
        one = next(r for r in rows if (r.noise_px, r.model, r.sharing) == (noise_px, model, sharing))
        lines.append([f"{noise_px:g}", model, sharing, *map(_cell, cells), f"{one.failed} of {one.seeds}"])
    header = ["noise (px)", "model", "sharing", *(_METRICS[m] for m in names), "failed"]
    return _table(header, lines)


def _real(results: Results) -> str:
    """One column for each model, one row for each metric."""
    rows = [r for r in results.rows if r.experiment == OPPORTUNITY]
    models = list(dict.fromkeys(r.model for r in rows))
    by = {(r.model, r.metric): r for r in rows}
    lines = []
    for metric in dict.fromkeys(r.metric for r in rows):
        cells = [by.get((m, metric)) for m in models]
        lines.append([metric.replace("_", " "), *("" if c is None else number(c.median) for c in cells)])
    return _table(["", *models], lines)


def _cell(row: Row | None) -> str:
    return "" if row is None else f"{number(row.median)} ({number(row.q05)} to {number(row.q95)})"


def _table(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    rule = ["---"] * len(header)
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (header, rule, *lines))
