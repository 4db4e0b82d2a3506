"""Terrain of a rendered drive as the program makes it, against the truth of the rendering."""

import itertools
import json
import resource
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np

from pancam_graph import RenderOptions, render, write_rendering
from pancam_graph.base.errors import InputError
from pancam_graph.base.extras import needed
from pancam_graph.base.geometry import FloatArray
from pancam_graph.images import cache_folder, find_masks
from pancam_graph.results import read_drive
from pancam_graph.rigs import rig_template
from pancam_graph.simulate import Rendering
from pancam_graph.terrain import Drive
from pancam_graph.terrain._drive import Pair, stereo_pairs
from pancam_graph.terrain._match import disparity_limits, match, rectified_picture
from pancam_graph.terrain._rectify import Rectified, rectify

__all__ = ["Heights", "Measures", "Process", "measure_terrain", "table"]

RINGS_M = ((0.0, 5.0), (5.0, 12.0), (12.0, 50.0))
COMPLETE_M = 2.0, 20.0
GROSS_PX = 1.5
CELLS = ((0.02, 6.0), (0.1, 15.0))
"""Cells and how far from a mast their heights are compared, metres."""
GROUND_M = (0.0, 3.0, 6.0, 10.0, 15.0)
PHASES = 8
LEAST_CELLS, MOST_CELLS = 1000, 300_000
FOOTPRINT_M = 0.004
FINEST_M = 0.01
"""Distance of places whose heights are averaged to the truth of a cell."""
FAR_SIGMAS = 5.0
MARGIN_PX = 4
NEAREST_M, FARTHEST_M = 1.0, 50.0


@dataclass(frozen=True, kw_only=True)
class Process:
    """One run of the program."""

    seconds: float
    processor_s: float
    memory_mb: float | None
    """None where the system does not say."""
    status: int


@dataclass(frozen=True, kw_only=True)
class Heights:
    """Errors of heights in a ring about the masts."""

    cell_m: float
    nearest_m: float
    farthest_m: float
    cells: int
    rms_m: float
    robust_m: float
    squared: float
    """Mean squared error over variance, those beyond 5 sigmas as 25."""
    squared_median: float
    """The same by the median."""


@dataclass(frozen=True, kw_only=True)
class Measures:
    """What one drive gave."""

    rig: str
    seed: int
    completeness: float
    """Share of pixels that both eyes see, 2 to 20 m away, with a disparity."""
    gross: float
    """Share of these disparities that are wrong by more than 1.5 px."""
    robust_px: dict[str, tuple[float, float]]
    """By ring: robust error of semi-global matching alone, and ours."""
    phase_px: list[float]
    """Median error by eighths of a pixel of the true disparity."""
    disparity_squared: list[float]
    """By ring: mean squared error over variance."""
    heights: list[Heights]
    telemetry_m: float
    refined_m: float
    sigmas: float
    refine: Process
    terrain: Process


def measure_terrain(
    rig: str,
    seed: int,
    folder: Path,
    *,
    pans: int = 10,
    pictures: int = 6,
    rig_error: Literal["none", "drawn"] = "none",
) -> Measures:
    """Render a drive of two stops 5 m apart, refine it, make terrain, each as a process, and compare.

    `folder` gets drive and results; a drive that an earlier run left there is used again. Disparities are
    compared in `pictures` of the stereo frames, evenly chosen. `rig_error` is as in `RenderOptions`. Raises
    InputError where the program fails.
    """
    options = RenderOptions(stops=2, spacing_m=5.0, pans=pans, rig_error=rig_error)
    rendering = render(rig_template(rig), options, seed=seed)
    drive, out = folder / f"{rig}-{seed}", folder / f"{rig}-{seed}-out"
    if not drive.exists():
        write_rendering(rendering, drive)
    refine = _run("refine", str(drive), "--out", str(out))
    heights, terrain, index = list[Heights](), refine, dict[str, object]()
    for cell_m, reach_m in CELLS:
        once = _run("terrain", str(out), "--cell", str(cell_m))
        index = index or json.loads((out / "terrain" / "terrain.json").read_text())
        terrain = terrain if heights else once
        heights += list(_heights(rendering, out / "terrain", cell_m, reach_m))
    disagreement = index["disagreement_m"]
    assert isinstance(disagreement, dict)
    return Measures(
        rig=rig,
        seed=seed,
        **_disparities(rendering, read_drive(out), out, pictures)._asdict(),
        heights=heights,
        telemetry_m=float(disagreement["telemetry"] or np.nan),
        refined_m=float(disagreement["refined"] or np.nan),
        sigmas=float(index["disagreement_sigmas"] or np.nan),  # type: ignore[arg-type]  # a number or null
        refine=refine,
        terrain=terrain,
    )


def table(measures: Sequence[Measures]) -> str:
    """A table for docs/terrain.md: a row a figure, a column a drive; what issue 18 asks in brackets."""
    rows = [("", [f"{m.rig} {m.seed}" for m in measures])]
    rows += [
        (
            "found of what both eyes see, 2 to 20 m (98 %)",
            [f"{100 * m.completeness:.2f} %" for m in measures],
        ),
        ("wrong by more than 1.5 px (0.5 %)", [f"{100 * m.gross:.3f} %" for m in measures]),
    ]
    for k, ring in enumerate(measures[0].robust_px):
        both = [m.robust_px[ring] for m in measures]
        rows += [
            (f"disparity, {ring}: semi-global, here", [f"{a:.3f}, {b:.3f} px" for a, b in both]),
            ("their ratio (0.6)", [f"{b / a:.3f}" for a, b in both]),
            ("squared error over variance", [f"{m.disparity_squared[k]:.2f}" for m in measures]),
        ]
    rows += [
        (
            "largest bias at any eighth of a pixel (0.015 px)",
            [f"{max(map(abs, m.phase_px)):.4f} px" for m in measures],
        )
    ]
    for n, h in enumerate(measures[0].heights):
        name = f"heights, cells of {100 * h.cell_m:g} cm, {h.nearest_m:g} to {h.farthest_m:g} m"
        own = [m.heights[n] for m in measures]
        rows += [
            (f"{name}: RMS; robust", [f"{1e3 * h.rms_m:.1f}; {1e3 * h.robust_m:.1f} mm" for h in own]),
            (
                "squared error over variance (0.7 to 1.4): mean; by the median",
                [f"{h.squared:.2f}; {h.squared_median:.2f}" for h in own],
            ),
        ]
    rows += [
        (
            "frames differ, telemetry to refined (threefold)",
            [f"{100 * m.telemetry_m:.2f} to {100 * m.refined_m:.2f} cm" for m in measures],
        ),
        ("refined, in sigmas (0.67)", [f"{m.sigmas:.2f}" for m in measures]),
    ]
    rows += [
        (
            f"pancam-graph {name}: time; processor time; memory",
            [_process(getattr(m, name)) for m in measures],
        )
        for name in ("refine", "terrain")
    ]
    lines = ["| " + " | ".join([name, *cells]) + " |" for name, cells in rows]
    return "\n".join([lines[0], "| --- " * (len(measures) + 1) + "|", *lines[1:]])


def _process(run: Process) -> str:
    memory = "unknown" if run.memory_mb is None else f"{run.memory_mb / 1e3:.2f} GB"
    return f"{run.seconds:.0f} s; {run.processor_s:.0f} s; {memory} (status {run.status})"


def _run(*words: str) -> Process:
    """Run the program with these words; raises InputError where it wrote nothing."""
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    with subprocess.Popen([sys.executable, "-m", "pancam_graph", *words, "--quiet"]) as process:
        status_file, memory_mb = Path(f"/proc/{process.pid}/status"), None
        while process.poll() is None:
            memory_mb = _peak_mb(status_file) or memory_mb
            time.sleep(0.1)
    seconds = time.perf_counter() - begin
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if process.returncode not in {0, 1}:
        raise InputError(
            f"pancam-graph {' '.join(words)}: expected results, found status {process.returncode}"
        )
    return Process(
        seconds=seconds,
        processor_s=after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        memory_mb=memory_mb,
        status=process.returncode,
    )


def _peak_mb(status: Path) -> float | None:
    """Largest resident memory of a running process, megabytes; None where it has ended or is not told."""
    try:
        lines = status.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith("VmHWM:")), None)


class _Disparities(NamedTuple):
    completeness: float
    gross: float
    robust_px: dict[str, tuple[float, float]]
    phase_px: list[float]
    disparity_squared: list[float]


def _disparities(rendering: Rendering, drive: Drive, out: Path, pictures: int) -> _Disparities:
    """Errors of disparities of some frames, all pixels of these together."""
    pairs, _ = stereo_pairs(drive)
    masks = find_masks(drive.traverse, cache=cache_folder(out))
    parts = list[FloatArray]()
    for k in np.linspace(0, len(pairs) - 1, min(pictures, len(pairs))).round().astype(int):
        pair, rectified = pairs[k], rectify(drive, pairs[k])
        truth, depth = _true_disparity(rendering, drive, pair, rectified)
        seen = []
        for row, uv_px in zip((pair.left, pair.right), rectified.maps, strict=True):
            mask = masks[row]
            assert mask is not None  # rendered pictures are all there
            seen.append(rectified_picture(rendering.image(row), mask.usable(between_stops=True), uv_px))
        limits = disparity_limits(rectified, NEAREST_M, FARTHEST_M)
        found = match(seen[0][0], seen[1][0], (seen[0][1], seen[1][1]), limits)
        plain = _semi_global(seen[0][0].astype(float), seen[1][0].astype(float), limits)
        both = np.isfinite(truth)
        columns = (truth, depth, found.disparity_px, found.sigma_px, plain)
        parts.append(np.stack([np.asarray(c, dtype=float)[both] for c in columns]))
    truth, depth, ours, sigma, plain = np.concatenate(parts, axis=1)
    near = (depth > COMPLETE_M[0]) & (depth < COMPLETE_M[1])
    off, plain_off, known = ours - truth, plain - truth, near & np.isfinite(ours)
    robust_px, squared = dict[str, tuple[float, float]](), list[float]()
    for nearest, farthest in RINGS_M:
        ring = (depth > nearest) & (depth < farthest)
        own, others = ring & np.isfinite(off), ring & np.isfinite(plain_off)
        robust_px[f"{nearest:.0f} to {farthest:.0f} m"] = _robust(plain_off[others]), _robust(off[own])
        squared.append(_squared(off[own] / sigma[own])[0])
    phase = truth[known] % 1
    return _Disparities(
        completeness=float(np.isfinite(ours[near]).mean()),
        gross=float(np.mean(np.abs(off[known]) > GROSS_PX)),
        robust_px=robust_px,
        phase_px=[
            float(np.median(off[known][(phase >= k / PHASES) & (phase < (k + 1) / PHASES)]))
            for k in range(PHASES)
        ],
        disparity_squared=squared,
    )


def _true_disparity(
    rendering: Rendering, drive: Drive, pair: Pair, rectified: Rectified
) -> tuple[FloatArray, FloatArray]:
    """Disparity and depth (h, w) of what both eyes see; NaN elsewhere.

    What a pixel shows is followed through the true cameras to the other picture, and from there through the
    refined ones into the rectified pair: errors of the refined poses are not errors of matching.
    """
    hole, uv_px = rectified.left, rectified.maps[0]
    inside = np.isfinite(uv_px).all(axis=-1)
    world, hit = rendering.points(pair.left, uv_px[inside])
    R, t = _true_poses(rendering)
    camera = rendering.truth.rig.eyes[int(rendering.traverse.image_eye[pair.right])].camera
    other_px, valid = camera.project((world - t[pair.right]) @ R[pair.right])
    valid &= hit & camera.contains(other_px)
    # What hides it from the other eye is nearer.
    there, there_hit = rendering.points(pair.right, np.where(valid[:, None], other_px, 0.0))
    depth = (world - t[pair.left]) @ R[pair.left][:, 2]
    baseline_px = hole.fx_px * rectified.baseline_m
    apart = np.linalg.norm(there - t[pair.right], axis=1) / np.linalg.norm(world - t[pair.right], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        valid &= there_hit & (np.abs(baseline_px / depth * (1 / apart - 1)) < 1)
    rays = drive.cameras[pair.right].unproject(other_px)
    seen = rays.direction @ (drive.world_R_camera[pair.right].T @ rectified.world_R_pair)
    with np.errstate(divide="ignore", invalid="ignore"):
        column = rectified.right.fx_px * seen[:, 0] / seen[:, 2] + rectified.right.cx_px
    disparity, depths = np.full(inside.shape, np.nan), np.full(inside.shape, np.nan)
    row, u = np.nonzero(inside)
    size = rectified.right.width_px, rectified.right.height_px
    valid &= (u >= MARGIN_PX) & (u < size[0] - MARGIN_PX) & (row >= MARGIN_PX) & (row < size[1] - MARGIN_PX)
    with np.errstate(invalid="ignore"):
        valid &= (column > MARGIN_PX) & (column < size[0] - 1 - MARGIN_PX)
    disparity[inside] = np.where(valid, u - column, np.nan)
    depths[inside] = depth
    return disparity, depths


def _true_poses(rendering: Rendering) -> tuple[FloatArray, FloatArray]:
    """Orientations and centres of all cameras."""
    truth = rendering.truth
    posed = replace(rendering.traverse, rig=truth.rig)
    return posed.camera_poses(truth.world_T_mast, truth.pan_tilt_rad, truth.flex)


def _semi_global(left: FloatArray, right: FloatArray, limits: tuple[float, float]) -> FloatArray:
    """OpenCV's semi-global matching of two pictures; NaN where it finds nothing."""
    low = int(np.floor(limits[0])) - 1
    count = -(-(int(np.ceil(limits[1])) - low + 1) // 16) * 16
    before, behind = max(low + count, 0), max(-low, 0)
    matcher = cv2.StereoSGBM.create(
        minDisparity=low,
        numDisparities=count,
        blockSize=5,
        P1=200,
        P2=800,
        disp12MaxDiff=1,
        uniquenessRatio=5,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    scale = 255 / max(float(left.max()), 255.0)
    wide = (
        cv2.copyMakeBorder(
            np.clip(scale * p, 0, 255).astype(np.uint8), 0, 0, before, behind, cv2.BORDER_REPLICATE
        )
        for p in (left, right)
    )
    found = matcher.compute(*wide)[:, before : before + left.shape[1]].astype(float) / 16
    return np.where(found >= low, found, np.nan)


def _heights(rendering: Rendering, folder: Path, cell_m: float, reach_m: float) -> Iterator[Heights]:
    """Errors of the heights of `dem.tif` against means over each cell, by the distance from a mast."""
    rasterio = needed("rasterio", "terrain")
    with rasterio.open(folder / "dem.tif") as file:
        height, sigma = file.read(1).astype(float), file.read(2).astype(float)
        place = file.transform
    x = place.c + place.a * (np.arange(height.shape[1]) + 0.5)
    y = place.f + place.e * (np.arange(height.shape[0]) + 0.5)
    masts = np.array([pose.translation() for pose in rendering.truth.world_T_mast])
    away = np.min([np.hypot(x - m[0], (y - m[1])[:, None]) for m in masts], axis=0)
    cells = np.flatnonzero(np.isfinite(height) & (away < GROUND_M[-1]))
    if len(cells) > MOST_CELLS:
        cells = np.random.default_rng(0).choice(cells, MOST_CELLS, replace=False)
    row, column = np.unravel_index(cells, away.shape)
    n = max(2, round(cell_m / FINEST_M / 2) * 2)
    aside = cell_m * ((np.arange(n) + 0.5) / n - 0.5)
    places = np.column_stack([x[column], y[row]])
    truth = np.mean(
        [rendering.heights_m(places + np.array([p, q]), FOOTPRINT_M) for p in aside for q in aside], axis=0
    )
    off, sigmas, distance = height.ravel()[cells] - truth, sigma.ravel()[cells], away.ravel()[cells]
    for nearest, farthest in [(0.0, reach_m), *itertools.pairwise(GROUND_M)]:
        ring = (distance >= nearest) & (distance < farthest) & np.isfinite(off)
        if ring.sum() < LEAST_CELLS:  # coarser grids have it
            continue
        squared = _squared(off[ring] / sigmas[ring])
        yield Heights(
            cell_m=cell_m,
            nearest_m=nearest,
            farthest_m=farthest,
            cells=int(ring.sum()),
            rms_m=float(np.sqrt(np.mean(off[ring] ** 2))),
            robust_m=_robust(off[ring]),
            squared=squared[0],
            squared_median=squared[1],
        )


def _robust(off: FloatArray) -> float:
    """Standard deviation by the median of absolute deviations."""
    return float(1.4826 * np.median(np.abs(off - np.median(off))))


def _squared(off_in_sigmas: FloatArray) -> tuple[float, float]:
    """Mean of squares, those beyond some sigmas counted as there, and what the median says of it."""
    square = off_in_sigmas**2
    return float(np.mean(np.minimum(square, FAR_SIGMAS**2))), float(np.median(square)) / 0.455
