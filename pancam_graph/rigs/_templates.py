"""Rigs that ship with the package, by name. To add one: a module with its rigs, and a line in `TEMPLATES`."""

from collections.abc import Callable

from pancam_graph.base.errors import InputError
from pancam_graph.rigs._exomars import EXOMARS_TEMPLATES
from pancam_graph.rigs._mars2020 import MARS2020_TEMPLATES
from pancam_graph.rigs._mer import MER_TEMPLATES
from pancam_graph.rigs._msl import MSL_TEMPLATES
from pancam_graph.rigs._rig import Rig
from pancam_graph.rigs._rings import RING_TEMPLATES
from pancam_graph.rigs._stereo import STEREO_TEMPLATES

__all__ = ["TEMPLATES", "rig_template"]

TEMPLATES: dict[str, Callable[[], Rig]] = {
    **MER_TEMPLATES,
    **MSL_TEMPLATES,
    **MARS2020_TEMPLATES,
    **EXOMARS_TEMPLATES,
    **RING_TEMPLATES,
    **STEREO_TEMPLATES,
}
"""The templates by the name that `traverse.json` uses."""


def rig_template(name: str) -> Rig:
    """A shipped rig by name. Raises InputError for an unknown one, naming those there are."""
    if name not in TEMPLATES:
        raise InputError(f"template: expected one of {', '.join(TEMPLATES)}; found {name!r}")
    return TEMPLATES[name]()
