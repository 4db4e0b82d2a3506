"""The rovers whose PDS labels are read. To add one: a module with its `LabelledRover`, a line in `ROVERS`."""

from pancam_graph.base.errors import InputError
from pancam_graph.io._pds_label import PdsLabel
from pancam_graph.io._pds_mars2020 import MARS2020
from pancam_graph.io._pds_mer import MER
from pancam_graph.io._pds_msl import MSL
from pancam_graph.io._pds_rover import LabelledRover

__all__ = ["ROVERS", "rover_of"]

ROVERS: tuple[LabelledRover, ...] = (MER, MSL, MARS2020)


def rover_of(label: PdsLabel) -> tuple[LabelledRover, str, str]:
    """The rover of a label, its INSTRUMENT_HOST_ID and its INSTRUMENT_ID.

    Raises InputError for a spacecraft that is none of the `ROVERS`, and for a camera that is not on its mast.
    """
    host = label.top.text("INSTRUMENT_HOST_ID").upper()
    instrument = label.top.text("INSTRUMENT_ID").upper()
    rover = next((known for known in ROVERS if host.startswith(known.hosts)), None)
    if rover is None:
        *first, last = (known.named for known in ROVERS)
        raise InputError(
            f"{label.label_file}: INSTRUMENT_HOST_ID: expected {', '.join(first)} or {last}, found {host!r}"
        )
    if not instrument.startswith(rover.cameras):
        names = ", ".join(name.rstrip("_") for name in rover.cameras)
        raise InputError(
            f"{label.label_file}: INSTRUMENT_ID: expected a camera on the mast ({names}), "
            f"found {instrument!r}"
        )
    return rover, host, instrument
