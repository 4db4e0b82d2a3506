"""Command lines of programs that make a drive up."""

from pathlib import Path
from typing import Any, Generic, TypeVar

from pancam_graph.cli._program import Parser, degrees, show_log
from pancam_graph.rigs import TEMPLATES, Rig, rig_template
from pancam_graph.simulate import DriveOptions

__all__ = ["DriveParser"]

Options = TypeVar("Options", bound=DriveOptions)


class DriveParser(Parser, Generic[Options]):
    """Parser of what is made up by driving: the options that all such scripts have, with their defaults."""

    def __init__(
        self, description: str, options: type[Options], *, pans: str, sweep: str, tilts: str
    ) -> None:
        super().__init__(description)
        self._options = options
        d, add = options(), self.add_argument
        add("--rig", choices=TEMPLATES, default="mer-navcam", help="cameras (%(default)s)")
        add("--seed", type=int, default=0, help="another seed, another world (%(default)s)")
        add("--stops", type=int, default=d.stops, help="places of the mast (%(default)s)")
        add(
            "--spacing-m", "--step-m", type=float, default=d.spacing_m, help="from stop to stop (%(default)s)"
        )
        add("--pans", "--azimuths", type=int, default=d.pans, help=f"frames per row ({pans})")
        add("--sweep-deg", **_angle("sweep_rad", d.sweep_rad), help=f"range of pan ({sweep})")
        add("--tilts-deg", **_angle("tilts_rad"), nargs="+", help=f"of each row, up positive ({tilts})")
        add("--pointing-scale", type=float, default=1.0, help="errors of pan and tilt, times the rig's (1)")
        add("--sigma-stop-m", type=float, default=d.sigma_stop_m, help="odometry's, per axis (%(default)s)")
        add("--sigma-stop-deg", **_angle("sigma_stop_rad", d.sigma_stop_rad), help="(0.57)")
        add("--focal-error", type=float, default=0.0, help="of the rig that the traverse claims, a share (0)")
        add("--mount-error-deg", **_angle("mount_error_rad", 0.0), help="of its mounts (0)")
        add("--mount-error-m", type=float, default=0.0, help="of its mounts (0)")
        add("--radius-error-m", type=float, default=0.0, help="of its circles (0)")

    def parse_drive(self) -> tuple[Path, Rig, int, Options]:
        """OUT, the rig, the seed, and all other arguments as options; the log is on from here.

        Raises InputError for options that make no sense.
        """
        a = vars(self.parse_args())
        out, rig, seed, verbose = (a.pop(k) for k in ("out", "rig", "seed", "verbose"))
        show_log(verbose=verbose)
        tilts = a.pop("tilts_rad")
        return out, rig_template(rig), seed, self._options(**a, tilts_rad=tilts and tuple(tilts))


def _angle(name: str, default: float | None = None) -> dict[str, Any]:
    """How an option in degrees sets a field in radians."""
    return {"dest": name, "type": degrees, "default": default}
