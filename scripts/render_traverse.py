"""Render a rover traverse with known truth: image files, and a traverse folder without observations.

OUT gets images/*.png, traverse.json with "observations": null and disturbed telemetry, which
scripts/optimize_traverse.py reads, and truth.npz, which no solver reads: world_T_mast (stops,4,4) and
pan_tilt_rad (frames,2). Metres, radians, z up. Same options, same bytes.

Exit status: 0 written, 2 bad input (nothing is written).
"""

from pathlib import Path

from pancam_graph.cli._drive_options import DriveParser
from pancam_graph.cli._program import Progress, degrees, run
from pancam_graph.simulate import RenderOptions, render, write_rendering


def main() -> int:
    """Render and write."""
    d = RenderOptions()
    parser = DriveParser(
        __doc__ or "",
        RenderOptions,
        pans="%(default)s",
        sweep="as far as frames overlap by 20 %%",
        tilts="one row",
    )
    add = parser.add_argument
    add("--out", metavar="OUT", type=Path, required=True, help="folder to write; must be new or empty")
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
    out, rig, seed, options = parser.parse_drive()
    progress = Progress()
    with progress.shown("making a world"):
        rendering = render(rig, options, seed=seed)
        write_rendering(rendering, out, progress=lambda done, n: progress.counted("rendering", done, n))
    print(f"{out}: {options.stops} stops, {len(rendering.traverse.images)} images")
    return 0


if __name__ == "__main__":
    run(main)
