"""Simulate a rover traverse with known truth and write it as a traverse folder.

OUT gets traverse.json and observations.npz, which scripts/optimize_traverse.py reads, and truth.npz, which
no solver reads: world_T_mast (stops,4,4), pan_tilt_rad (frames,2), landmarks_m (tracks,3), and per
observation uv_px without noise and outlier. Metres, radians, z up. Same options, same numbers.

Exit status: 0 written, 2 bad input (nothing is written).
"""

from pathlib import Path

from pancam_graph.io import check_new, write_traverse, write_truth
from pancam_graph.program import Parser, degrees, run, show_log
from pancam_graph.rigs import TEMPLATES, rig_template
from pancam_graph.simulate import SimulationOptions, simulate


def main() -> int:
    """Simulate and write."""
    d, parser = SimulationOptions(), Parser(__doc__ or "")
    add = parser.add_argument
    add("out", metavar="OUT", type=Path, help="folder to write; must be new or empty")
    add("--rig", choices=TEMPLATES, default="mer-navcam", help="cameras (%(default)s)")
    add("--seed", type=int, default=0, help="another seed, another traverse (%(default)s)")
    add("--stops", type=int, default=d.stops, help="places of the mast (%(default)s)")
    add("--spacing-m", type=float, default=d.spacing_m, help="from stop to stop (%(default)s)")
    add("--pans", type=int, help="frames per row (so many that the widest eye's overlap by 28 %%)")
    add("--sweep-deg", dest="sweep_rad", type=degrees, default=d.sweep_rad, help="range of pan (360)")
    add("--tilts-deg", dest="tilts_rad", type=degrees, nargs="+", help="of each row, up positive (two rows)")
    add("--points-per-image", type=int, default=d.points_per_image, help="density (%(default)s)")
    add("--noise-px", type=float, default=d.noise_px, help="sigma per coordinate (%(default)s)")
    add("--noise-stretch", type=float, default=1.0, help="length over width of error ellipses (1: round)")
    add("--outliers", type=float, default=d.outliers, help="share of random pixels (%(default)s)")
    add("--pointing-scale", type=float, default=1.0, help="errors of pan and tilt, times the rig's (1)")
    add("--sigma-stop-m", type=float, default=d.sigma_stop_m, help="odometry's, per axis (%(default)s)")
    add("--sigma-stop-deg", dest="sigma_stop_rad", type=degrees, default=d.sigma_stop_rad, help="(0.57)")
    add("--focal-error", type=float, default=0.0, help="of the rig that the traverse claims, a share (0)")
    add("--mount-error-deg", dest="mount_error_rad", type=degrees, default=0.0, help="of its mounts (0)")
    add("--mount-error-m", type=float, default=0.0, help="of its mounts (0)")
    add("--radius-error-m", type=float, default=0.0, help="of its circles (0)")
    a = vars(parser.parse_args())
    out, rig, seed, verbose = (a.pop(k) for k in ("out", "rig", "seed", "verbose"))
    show_log(verbose=verbose)
    check_new(out)
    options = SimulationOptions(**{**a, "tilts_rad": a["tilts_rad"] and tuple(a["tilts_rad"])})
    s = simulate(rig_template(rig), options, seed=seed)
    write_traverse(s.traverse, out)
    write_truth(s.truth, out)
    counts = f"{len(s.traverse.stops)} stops, {len(s.traverse.images)} images"
    print(f"{out}: {counts}, {len(s.truth.landmarks_m)} tracks, {len(s.truth.uv_px)} observations")
    return 0


if __name__ == "__main__":
    run(main)
