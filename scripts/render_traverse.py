"""Render a rover traverse with known truth: image files, and a traverse folder without observations.

OUT gets images/*.png, traverse.json with "observations": null and disturbed telemetry, which
scripts/optimize_traverse.py reads, and truth.npz, which no solver reads: world_T_mast (stops,4,4) and
pan_tilt_rad (frames,2). Metres, radians, z up. Same options, same bytes.

Exit status: 0 written, 2 bad input (nothing is written).
"""

from pathlib import Path

from pancam_graph.io import write_rendering
from pancam_graph.program import Parser, Progress, degrees, run, show_log
from pancam_graph.rigs import TEMPLATES, rig_template
from pancam_graph.simulate import RenderOptions, render


def main() -> int:
    """Render and write."""
    d, parser = RenderOptions(), Parser(__doc__ or "")
    add = parser.add_argument
    add("--out", metavar="OUT", type=Path, required=True, help="folder to write; must be new or empty")
    add("--rig", choices=TEMPLATES, default="mer-navcam", help="cameras (%(default)s)")
    add("--seed", type=int, default=0, help="another seed, another world (%(default)s)")
    add("--stops", type=int, default=d.stops, help="places of the mast (%(default)s)")
    add("--spacing-m", "--step-m", type=float, default=d.spacing_m, help="from stop to stop (%(default)s)")
    add("--pans", "--azimuths", type=int, default=d.pans, help="frames per row (%(default)s)")
    add(
        "--sweep-deg",
        dest="sweep_rad",
        type=degrees,
        help="range of pan (as far as frames overlap by 20 %%)",
    )
    add("--tilts-deg", dest="tilts_rad", type=degrees, nargs="+", help="of each row, up positive (one row)")
    add("--rocks", dest="rock_abundance", type=float, default=d.rock_abundance, help="share of ground (0.05)")
    add(
        "--sun-elevation-deg",
        dest="sun_elevation_rad",
        type=degrees,
        default=d.sun_elevation_rad,
        help="(38)",
    )
    add("--bits", type=int, choices=(8, 12), default=d.bits, help="of samples; 12 in 16-bit files (8)")
    add("--deck", action="store_true", help="show the rover's own deck, which moves along with it")
    add("--pointing-scale", type=float, default=1.0, help="errors of pan and tilt, times the rig's (1)")
    add("--sigma-stop-m", type=float, default=d.sigma_stop_m, help="odometry's, per axis (%(default)s)")
    add("--sigma-stop-deg", dest="sigma_stop_rad", type=degrees, default=d.sigma_stop_rad, help="(0.57)")
    a = vars(parser.parse_args())
    out, rig, seed, verbose = (a.pop(k) for k in ("out", "rig", "seed", "verbose"))
    show_log(verbose=verbose)
    options = RenderOptions(**{**a, "tilts_rad": a["tilts_rad"] and tuple(a["tilts_rad"])})
    progress = Progress()
    with progress.shown("making a world"):
        rendering = render(rig_template(rig), options, seed=seed)
        write_rendering(rendering, out, progress=lambda done, n: progress.counted("rendering", done, n))
    print(f"{out}: {options.stops} stops, {len(rendering.traverse.images)} images")
    return 0


if __name__ == "__main__":
    run(main)
