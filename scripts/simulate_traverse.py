"""Simulate a rover traverse with known truth and write it as a traverse folder.

OUT gets traverse.json and observations.npz, which scripts/optimize_traverse.py reads, and truth.npz, which
no solver reads: world_T_mast (stops,4,4), pan_tilt_rad (frames,2), landmarks_m (tracks,3), and per
observation uv_px without noise and outlier. Metres, radians, z up. Same options, same numbers.

Exit status: 0 written, 2 bad input (nothing is written).
"""

from pathlib import Path

from pancam_graph.cli._drive_options import DriveParser
from pancam_graph.cli._program import run
from pancam_graph.io import write_traverse
from pancam_graph.simulate import SimulationOptions, check_new, simulate, write_truth


def main() -> int:
    """Simulate and write."""
    d = SimulationOptions()
    parser = DriveParser(
        __doc__ or "",
        SimulationOptions,
        pans="so many that the widest eye's overlap by 28 %%",
        sweep="360",
        tilts="two rows",
    )
    add = parser.add_argument
    add("out", metavar="OUT", type=Path, help="folder to write; must be new or empty")
    add("--points-per-image", type=int, default=d.points_per_image, help="density (%(default)s)")
    add("--noise-px", type=float, default=d.noise_px, help="sigma per coordinate (%(default)s)")
    add("--noise-stretch", type=float, default=1.0, help="length over width of error ellipses (1: round)")
    add("--outliers", type=float, default=d.outliers, help="share of random pixels (%(default)s)")
    out, rig, seed, options = parser.parse_drive()
    check_new(out)
    s = simulate(rig, options, seed=seed)
    write_traverse(s.traverse, out)
    write_truth(s.truth, out)
    counts = f"{len(s.traverse.stops)} stops, {len(s.traverse.images)} images"
    print(f"{out}: {counts}, {len(s.truth.landmarks_m)} tracks, {len(s.truth.uv_px)} observations")
    return 0


if __name__ == "__main__":
    run(main)
