"""How far terrain is from the truth of a rendered drive, and what refining gains.

    python scripts/terrain_accuracy.py --seed 0 --pans 4

Renders a drive, refines it from its pictures, makes terrain, and prints for rings about the masts: robust
errors of disparities beside those of OpenCV's semi-global matching, with their bias by the fraction of a
pixel; errors of heights, and their squares over the variances that the terrain states; and by how much the
surfaces of frames differ with telemetry's and with the refined pointing.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from pancam_graph import RenderOptions, find_observations, read_traverse, render, solve, write_rendering
from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.cli import ScriptParser, run
from pancam_graph.rigs import rig_template
from pancam_graph.simulate import Rendering
from pancam_graph.terrain import Fused, TerrainOptions, drive_of, make_terrain
from pancam_graph.terrain._match import match

RINGS_M = ((0.0, 5.0), (5.0, 12.0), (12.0, 50.0))
GROUND_M = ((0.0, 3.0), (3.0, 6.0), (6.0, 10.0), (10.0, 15.0))
MOST_CELLS = 300_000
FOOTPRINT_M = 0.004


def main() -> int:
    """Parse options, measure, print."""
    parser = ScriptParser(__doc__ or "")
    parser.add_argument("--rig", default="mer-navcam", help="template of the cameras (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="another seed, another world (%(default)s)")
    parser.add_argument("--pans", type=int, default=4, help="frames a stop (%(default)s)")
    parser.add_argument("--cell", type=float, default=0.02, help="side of a cell, metres (%(default)s)")
    arguments = parser.parse_args()
    options = RenderOptions(stops=2, spacing_m=5.0, pans=arguments.pans)
    rendering = render(rig_template(arguments.rig), options, seed=arguments.seed)
    print_disparities(rendering)
    with TemporaryDirectory() as folder:
        write_rendering(rendering, Path(folder) / "drive")
        solution = solve(find_observations(read_traverse(Path(folder) / "drive")))
        terrain = make_terrain(drive_of(solution), TerrainOptions(cell_m=arguments.cell))
    print_heights(rendering, terrain.drive)
    before, after = (terrain.agreement.median_m(p) for p in ("telemetry", "refined"))
    print(
        f"disagreement of {len(terrain.agreement.pairs)} pairs of frames: {100 * before:.2f} cm with "
        f"telemetry, {100 * after:.2f} cm refined, "
        f"{terrain.agreement.median_sigmas:.2f} sigmas (expected: 0.67)"
    )
    return 0


def print_disparities(rendering: Rendering) -> None:
    """Errors in the first frame of a rig of parallel pinholes, whose pictures need no rectification."""
    rig = rendering.truth.rig
    R, centre = rig.mast_T_camera(np.zeros((2, 2)), np.arange(2))
    if not np.allclose(R[0], R[1], atol=1e-9):
        print("disparities: only of a rig with parallel eyes")
        return
    parallax = rig.pinholes[0].fx_px * float(np.linalg.norm(centre[1] - centre[0]))
    pictures = [rendering.image(row).astype(np.float32) for row in (0, 1)]
    depth, back = (rendering.depth_m(row) for row in (0, 1))
    truth = parallax / depth
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]].astype(np.float32)
    there = cv2.remap(
        (parallax / back).astype(np.float32), (u - truth).astype(np.float32), v, cv2.INTER_NEAREST
    )
    both = (np.abs(there - truth) < 1) & (u - truth > 4) & (u < u.max() - 4) & (v > 4) & (v < v.max() - 4)
    everywhere = np.ones(depth.shape, dtype=bool)
    high = 1.2 * float(np.nanmax(truth))
    found = match(pictures[0], pictures[1], (everywhere, everywhere), (0.0, high))
    plain = semi_global(pictures[0].astype(float), pictures[1].astype(float), high)
    for name, disparity in (("semi-global", plain), ("slanted windows", found.disparity_px.astype(float))):
        near = both & (depth > 2) & (depth < 20)
        off = disparity - truth
        print(
            f"{name}, 2 to 20 m: {100 * np.isfinite(off[near]).mean():.2f} % found, "
            f"{100 * np.nanmean(np.abs(off[near]) > 1.5):.3f} % wrong by more than 1.5 px"
        )
        for nearest, farthest in RINGS_M:
            ring = both & (depth > nearest) & (depth < farthest) & np.isfinite(off)
            print(f"  {nearest:.0f} to {farthest:.0f} m: robust error {robust(off[ring]):.4f} px")
        known = near & np.isfinite(off)
        print("  bias by phase, px:", " ".join(f"{b:+.4f}" for b in phases(off[known], truth[known])))
    known = both & np.isfinite(found.disparity_px) & (depth < 50)
    print(f"  squared error over variance: {squared((found.disparity_px - truth) / found.sigma_px, known)}")


def semi_global(left: FloatArray, right: FloatArray, high_px: float) -> FloatArray:
    """OpenCV's semi-global matching of two pictures; NaN where it finds nothing."""
    count = -(-int(high_px) // 16) * 16
    matcher = cv2.StereoSGBM.create(
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
        cv2.copyMakeBorder((scale * p).astype(np.uint8), 0, 0, count, 0, cv2.BORDER_REPLICATE)
        for p in (left, right)
    )
    found = matcher.compute(*wide)[:, count:].astype(float) / 16
    return np.where(found > 0, found, np.nan)


def print_heights(rendering: Rendering, fused: Fused) -> None:
    """Errors of heights against the mean of four places in each cell, by the distance from a mast."""
    x, y = fused.grid.middles()
    masts = np.array([pose.translation() for pose in rendering.truth.world_T_mast])
    away = np.min([np.hypot(x - m[0], (y - m[1])[:, None]) for m in masts], axis=0)
    cells = np.flatnonzero(np.isfinite(fused.height_m) & (away < GROUND_M[-1][1]))
    if len(cells) > MOST_CELLS:
        cells = np.random.default_rng(0).choice(cells, MOST_CELLS, replace=False)
    row, column = np.unravel_index(cells, away.shape)
    quarter = fused.grid.cell_m / 4
    corners = [np.array([p, q]) for p in (-quarter, quarter) for q in (-quarter, quarter)]
    places = np.column_stack([x[column], y[row]])
    truth = np.mean([rendering.heights_m(places + corner, FOOTPRINT_M) for corner in corners], axis=0)
    off, sigma = fused.height_m.ravel()[cells] - truth, fused.sigma_m.ravel()[cells]
    for nearest, farthest in GROUND_M:
        ring = (away.ravel()[cells] >= nearest) & (away.ravel()[cells] < farthest) & np.isfinite(off)
        print(
            f"heights, {nearest:.0f} to {farthest:.0f} m, cells of {100 * fused.grid.cell_m:g} cm: RMS "
            f"{1e3 * np.sqrt(np.mean(off[ring] ** 2)):.1f} mm, robust {1e3 * robust(off[ring]):.1f} mm, "
            f"{100 * np.mean(np.abs(off[ring]) > 0.03):.2f} % by more than 3 cm, squared error over variance "
            f"{squared(off / sigma, ring)}"
        )


def robust(off: FloatArray) -> float:
    """Standard deviation by the median of absolute deviations."""
    return float(1.4826 * np.median(np.abs(off - np.median(off))))


def phases(off: FloatArray, truth: FloatArray) -> list[float]:
    """Median error in each eighth of a pixel."""
    phase = truth % 1
    return [float(np.median(off[(phase >= k / 8) & (phase < (k + 1) / 8)])) for k in range(8)]


def squared(off_in_sigmas: FloatArray, kept: BoolArray) -> str:
    """Mean of squares, those beyond 5 sigmas counted as 25, and what the median of squares says of it."""
    square = off_in_sigmas[kept] ** 2
    return f"{np.mean(np.minimum(square, 25)):.2f} (by the median {np.median(square) / 0.455:.2f})"


if __name__ == "__main__":
    run(main)
