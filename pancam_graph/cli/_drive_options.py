"""Options of the subcommands that make a drive up."""

from argparse import Namespace
from collections.abc import Iterable
from dataclasses import fields
from typing import TYPE_CHECKING, Any, TypeVar

from pancam_graph.cli._parser import CommandParser, LateChoice, degrees

if TYPE_CHECKING:
    from pancam_graph.simulate import DriveOptions

__all__ = ["add_drive_options", "add_rig_option", "drive_options"]

_Options = TypeVar("_Options", bound="DriveOptions")


def _templates() -> Iterable[str]:
    from pancam_graph.rigs import TEMPLATES

    return TEMPLATES


def add_rig_option(parser: CommandParser) -> None:
    """Add the name of a rig template."""
    help_text = "template of the cameras and the mast (%(default)s); an unknown one lists all"
    parser.add_argument(
        "--rig", type=LateChoice(_templates), default="mer-navcam", metavar="RIG", help=help_text
    )


def add_drive_options(
    parser: CommandParser,
    *,
    stops: int,
    spacing_m: float,
    pans: int | None,
    sweep_rad: float | None,
    say_pans: str,
    say_sweep: str,
    say_tilts: str,
) -> None:
    """Add the options that all subcommands with a drive have.

    The numbers are the defaults of those options in which the subcommands differ; the texts say in help what
    happens without an option where no number can. They must agree with the defaults of the options' class.
    """
    add = parser.add_argument
    add_rig_option(parser)
    add("--seed", type=int, default=0, help="another seed, another world (%(default)s)")
    add("--stops", type=int, default=stops, help="number of places where the mast stands (%(default)s)")
    add(
        "--spacing-m",
        "--step-m",
        type=float,
        default=spacing_m,
        help="distance from stop to stop, metres (%(default)s)",
    )
    add("--pans", "--azimuths", type=int, default=pans, help=f"number of frames per row ({say_pans})")
    add("--sweep-deg", **_angle("sweep_rad", sweep_rad), help=f"range of pan that a row covers ({say_sweep})")
    add("--tilts-deg", **_angle("tilts_rad"), nargs="+", help=f"tilt of each row, up positive ({say_tilts})")
    add("--pointing-scale", type=float, default=1.0, help="factor on the rig's errors of pan and tilt (1)")
    add(
        "--sigma-stop-m",
        type=float,
        default=0.1,
        help="sigma of the telemetry's place of a stop, per axis (%(default)s)",
    )
    add(
        "--sigma-stop-deg",
        **_angle("sigma_stop_rad", 0.01),
        help="sigma of the telemetry's attitude of a stop, per axis (0.57)",
    )
    add(
        "--focal-error",
        type=float,
        default=0.0,
        help="error of the focal lengths that traverse.json claims, a share (0)",
    )
    add(
        "--mount-error-deg",
        **_angle("mount_error_rad", 0.0),
        help="error of the turns of mounts that it claims (0)",
    )
    add("--mount-error-m", type=float, default=0.0, help="error of the places of mounts that it claims (0)")
    add(
        "--rig-error",
        choices=("none", "drawn"),
        default="none",
        help="drawn: all numbers of the rig that it claims are off, as far as its uncertainty says (none)",
    )
    add("--radius-error-m", type=float, default=0.0, help="error of the radii of eyes that it claims (0)")


def drive_options(arguments: Namespace, options: type[_Options]) -> _Options:
    """The arguments as options. Raises InputError for options that make no sense."""
    given = vars(arguments)
    chosen: dict[str, Any] = {f.name: given[f.name] for f in fields(options) if f.name in given}
    tilts = chosen["tilts_rad"]
    return options(**{**chosen, "tilts_rad": None if tilts is None else tuple(tilts)})


def _angle(name: str, default: float | None = None) -> dict[str, Any]:
    """How an option in degrees sets a field in radians."""
    metavar = name.removesuffix("_rad").upper() + "_DEG"
    return {"dest": name, "type": degrees, "default": default, "metavar": metavar}
