"""What the main program, which refines a traverse, may be told."""

import argparse
from pathlib import Path

from pancam_graph.results import EXPORTS

__all__ = ["add_main_options"]

_SHARING_HELP = (
    "what of the rig is estimated, and who shares it: QUANTITY=SCOPE[:ENTRY[~SIGMA],...] with quantities "
    "calibration (fx_px fy_px skew_px cx_px cy_px, or focal), mounts and pan_T_tilt (rx_rad ry_rad rz_rad "
    "x_m y_m z_m), radius (radius_m; model circle) and scopes fixed, all, eye, stop, image; without entries "
    "all are free; SIGMA is the prior's, inf for none; what traverse.json says of a quantity is overridden; "
    "for example calibration=eye:focal mounts=eye"
)


def add_main_options(parser: argparse.ArgumentParser) -> None:
    """The traverse, the folder to write, and all options."""
    parser.add_argument("traverse", type=Path, metavar="TRAVERSE", help="folder to read")
    parser.add_argument("--out", type=Path, required=True, help="folder to write")
    parser.add_argument(
        "--model",
        choices=("mast", "circle", "free", "projective"),
        default="mast",
        help="mast: rigid pan-tilt mast (default); circle: camera centres on the mast's circles, rotations "
        "free; free: every camera on its own; projective: every projection matrix on its own",
    )
    parser.add_argument(
        "--landmarks",
        choices=("eliminated", "explicit"),
        default="eliminated",
        help="eliminated: terrain points follow the cameras (default); explicit: they are variables, slow",
    )
    parser.add_argument(
        "--method",
        choices=("joint", "alternation"),
        default="joint",
        help="joint: everything at once (default); alternation: what all stops share and everything else in "
        "turn, slow",
    )
    parser.add_argument(
        "--loss",
        choices=("none", "huber", "cauchy"),
        default="huber",
        help="robust loss while outliers are sought (default huber); none: keep every observation",
    )
    parser.add_argument(
        "--stop",
        action="append",
        default=[],
        metavar="NAME=NUMBER",
        help="when the final iterations end; may be given for each of max_iterations (default 100), "
        "relative_decrease (of the cost, 1e-7), relative_step, max_gradient, residual_sigmas; 0: not used",
    )
    parser.add_argument("--sharing", nargs="+", default=(), metavar="WORD", help=_SHARING_HELP)
    parser.add_argument(
        "--incremental",
        action="store_true",
        help="add the stops one by one as a rover does, with iSAM2 (model mast), a line for each",
    )
    parser.add_argument(
        "--cross-validate",
        action="store_true",
        help="solve halves of the terrain points too, and show honest sigmas beside the formal ones",
    )
    parser.add_argument(
        "--export",
        action="append",
        choices=EXPORTS,
        default=[],
        help="write a folder more into OUT (may be given for each); "
        + "; ".join(f"{name}: {says}" for name, says in EXPORTS.items()),
    )
    parser.add_argument(
        "--mosaic",
        action="store_true",
        help="write mosaics of each stop before and after too, around the horizon and from above",
    )
    parser.add_argument("--no-report", action="store_true", help="do not write report.html")
