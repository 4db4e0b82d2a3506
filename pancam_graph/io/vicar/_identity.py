"""Who an image is to the mission's programs: the unique id of VICAR's files, and the counters of its stop."""

import math
from dataclasses import dataclass

from pancam_graph.base.errors import InputError
from pancam_graph.data import Traverse
from pancam_graph.io._labelled_files import LABEL_SUFFIXES, labelled_files
from pancam_graph.io._labelled_image import LabelledImage

__all__ = ["PictureIdentity", "picture_identities"]

_MISSIONS = {"MER": "MER", "MSL": "MSL", "M20": "M20", "MARS": "M20"}
_POINTING = {"MER": "MERpmaCamera", "MSL": "MSLmastCamera", "M20": "M20mastCamera"}
"""Names of the pointing models of marsnav."""
_JOINTS = {"MER": ("Azimuth", "Elevation")}


@dataclass(frozen=True, kw_only=True)
class PictureIdentity:
    """An image as files of VICAR name it."""

    unique_id: str
    """Host, first letters of instrument and frame, clock (`MER1NL_491020376`); without a label, its id in the
    traverse."""
    image_id: str
    """Id of the image in the traverse."""
    is_labelled: bool
    """Whether a label says who it is."""
    mission: str
    """MER, MSL or M20; of other images "local"."""
    instrument: str
    """As the label names it; of other images the name of the eye."""
    frame_id: str
    """LEFT, RIGHT or MONO."""
    place: tuple[int, int]
    """Site and drive of the motion counter; of other images 0 and the row of the stop."""
    home_azimuth_rad: float = 0.0
    """Reading of the azimuth joint at pan 0; readings count clockwise from above, pans anticlockwise."""
    home_elevation_rad: float = 0.0
    """Reading of the elevation joint at tilt 0."""

    @property
    def pointing_type(self) -> str:
        """Name of the pointing model whose parameters the readings are."""
        return _POINTING.get(self.mission, "PanTiltCamera")

    @property
    def pointing_names(self) -> tuple[str, str]:
        """Names of the two parameters."""
        usual = (
            ("Joint Azimuth", "Joint Elevation") if self.mission in _POINTING else ("Azimuth", "Elevation")
        )
        return _JOINTS.get(self.mission, usual)

    def readings_deg(self, pan_rad: float, tilt_rad: float) -> tuple[float, float]:
        """Azimuth and elevation of the joints, degrees; azimuth in [0, 360)."""
        azimuth = math.degrees(self.home_azimuth_rad - pan_rad) % 360.0
        return azimuth, math.degrees(tilt_rad + self.home_elevation_rad)

    def pan_tilt_rad(self, azimuth_deg: float, elevation_deg: float) -> tuple[float, float]:
        """Pan, in [-pi, pi), and tilt of readings of the joints."""
        pan = self.home_azimuth_rad - math.radians(azimuth_deg)
        tilt = math.radians(elevation_deg) - self.home_elevation_rad
        return (pan + math.pi) % (2 * math.pi) - math.pi, tilt


def picture_identities(traverse: Traverse) -> tuple[PictureIdentity, ...]:
    """The identity of each image of a traverse, by the labels in its folder where there are any."""
    labelled: dict[str, LabelledImage] = {}
    if traverse.folder is not None and traverse.folder.is_dir():
        for parent in sorted(
            {(traverse.folder / i.file).parent for i in traverse.images if i.file is not None}
        ):
            if parent.is_dir() and any(f.suffix.lower() in LABEL_SUFFIXES for f in parent.iterdir()):
                labelled |= {str(image.file): image for image in labelled_files(parent).images}
    out = []
    for row, image in enumerate(traverse.images):
        label = (
            None
            if image.file is None or traverse.folder is None
            else labelled.get(str(traverse.folder / image.file))
        )
        out.append(
            PictureIdentity(
                unique_id=image.id,
                image_id=image.id,
                is_labelled=False,
                mission="local",
                instrument=image.camera,
                frame_id=_side(image.camera),
                place=(0, int(traverse.image_stop[row])),
            )
            if label is None
            else _of_label(label, image.id)
        )
    seen: dict[str, str] = {}
    for identity in out:
        other = seen.setdefault(identity.unique_id.lower(), identity.image_id)
        if other != identity.image_id:
            raise InputError(
                f"images: {identity.image_id}: expected a unique id of its own, found {identity.unique_id}, "
                f"which is that of {other} too"
            )
    return tuple(out)


def _of_label(label: LabelledImage, image_id: str) -> PictureIdentity:
    mission = next((m for start, m in _MISSIONS.items() if label.host.startswith(start)), "local")
    side = _side(label.instrument)
    host = label.host if mission in {"MER", "local"} else mission
    whole, _, ticks = (label.clock_start or "").partition(".")
    unique_id = image_id
    if whole:
        unique_id = f"{host}{label.instrument[:1]}{side[:1]}_{whole}"
        if mission == "M20":
            unique_id += f"_{ticks[:3].ljust(3, '0')}"
    return PictureIdentity(
        unique_id=unique_id,
        image_id=image_id,
        is_labelled=True,
        mission=mission,
        instrument=label.instrument,
        frame_id=side,
        place=label.stop,
        home_azimuth_rad=label.mast.home_azimuth_rad,
        home_elevation_rad=label.mast.home_elevation_rad,
    )


def _side(instrument: str) -> str:
    name = instrument.upper()
    return "LEFT" if "LEFT" in name else "RIGHT" if "RIGHT" in name else "MONO"
