"""Keys of a traverse's variables, for callers who write GTSAM factors of their own."""

from typing import NoReturn

import gtsam
import numpy as np

from pancam_graph.base.choices import expected_one_of, some_of
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import BoolArray
from pancam_graph.data import ENTRIES, Quantity, Traverse
from pancam_graph.graph._keys import Kind, key_of
from pancam_graph.graph._rig_variables import RigVariable, RigVariables

__all__ = ["GraphKeys"]

_NAMED = 6
_INDEX_BITS = 56
"""A key of GTSAM is a letter above so many bits of an index."""
_CALLED: dict[Quantity, str] = {
    "calibration": "calibration",
    "mounts": "mount",
    "pan_T_tilt": "tilt axis",
    "radius": "radius",
    "encoders": "encoders",
}


class GraphKeys:
    """Keys of masts, of pan and tilt, of flexes, and of the free entries of the rig, of one traverse.

    Masts are gtsam.Pose3 (`world_T_mast`; tangent in the mast's frame, rotation first, radians and metres).
    Angles are vectors (2,): pan and tilt of one frame, radians. Variables of the rig are vectors of
    corrections, 0 where a value is the rig's; those of `radius` are numbers, metres. A variable that
    telemetry holds (sigma 0) has a key too: a factor may name it, but it stays constant.
    """

    def __init__(self, traverse: Traverse, rig: RigVariables) -> None:
        """`rig` has the free entries of the traverse's rig."""
        self._traverse, self._rig = traverse, rig
        self._stop = {stop.id: key_of(Kind.MAST, i) for i, stop in enumerate(traverse.stops)}
        self._frame = {frame.id: key_of(Kind.ANGLES, i) for i, frame in enumerate(traverse.frames)}
        self._name = {key: f"mast of {stop}" for stop, key in self._stop.items()}
        self._name |= {key: f"angles of {frame}" for frame, key in self._frame.items()}
        flex = rig.sharing.flex.entries("flex")
        self._flex = {f.id: key_of(Kind.FLEX, i) for i, f in enumerate(traverse.frames) if flex}
        self._name |= {key: f"flex of {frame}" for frame, key in self._flex.items()}
        self._name |= {v.key: self._name_of(v) for v in rig.variables}
        self._entries: dict[int, tuple[str, ...]] = dict.fromkeys(self._stop.values(), ENTRIES["mounts"])
        self._entries |= dict.fromkeys(self._frame.values(), ("pan_rad", "tilt_rad"))
        self._entries |= dict.fromkeys(self._flex.values(), flex)
        self._entries |= {v.key: v.entries for v in rig.variables}

    def mast(self, stop: str) -> int:
        """Key of the mast pose of a stop, by its id. Raises InputError for an unknown id."""
        if stop not in self._stop:
            raise InputError(expected_one_of("stop", stop, list(self._stop)))
        return self._stop[stop]

    def angles(self, frame: str) -> int:
        """Key of pan and tilt of a frame, by its id. Raises InputError for an unknown id.

        In models other than `mast` these are the angles of the mast, to which camera poses are tied loosely.
        """
        if frame not in self._frame:
            raise InputError(expected_one_of("frame", frame, list(self._frame)))
        return self._frame[frame]

    def flex(self, frame: str) -> int:
        """Key of how a frame's head stands off the rigid mast, by its id: entries as in `Sharing.flex`.

        Raises InputError for an unknown id, and where heads do not flex.
        """
        if not self._flex:
            raise InputError("flex: expected it to be free, found it fixed; Sharing(flex=...) frees it")
        if frame not in self._flex:
            raise InputError(expected_one_of("frame", frame, list(self._flex)))
        return self._flex[frame]

    def calibration(
        self, camera: str | None = None, *, stop: str | None = None, image: str | None = None
    ) -> int:
        """Key of the free entries of a calibration, by those of camera, stop and image that identify it.

        Raises InputError where no calibration is free, and where several or none fit.
        """
        return self._rig_key("calibration", camera, stop, image)

    def mount(self, camera: str | None = None, *, stop: str | None = None, image: str | None = None) -> int:
        """Key of the free entries of a mount (`head_T_camera`); see `calibration`."""
        return self._rig_key("mounts", camera, stop, image)

    def tilt_axis(self, *, stop: str | None = None) -> int:
        """Key of the free entries of the tilt axis (`pan_T_tilt`); see `calibration`."""
        return self._rig_key("pan_T_tilt", None, stop, None)

    def encoders(self) -> int:
        """Key of the free entries of the scale of pans and tilts. Raises InputError where it is fixed."""
        return self._rig_key("encoders", None, None, None)

    def radius(self, camera: str | None = None, *, stop: str | None = None, image: str | None = None) -> int:
        """Key of the radius of a camera's circle (model `circle`); see `calibration`."""
        return self._rig_key("radius", camera, stop, image)

    def landmark(self, name: str) -> NoReturn:
        """Raise InputError: terrain points have no keys yet."""
        raise InputError(
            f"landmark {name!r}: expected a mast, angles or a variable of the rig; factors on terrain points "
            "are not supported yet"
        )

    def entries(self, key: int) -> tuple[str, ...]:
        """Names, with units, of the tangent's components of a key, in their order."""
        self.name(key)
        return self._entries[key]

    def dim(self, key: int) -> int:
        """Number of the tangent's components of a key."""
        return len(self.entries(key))

    def name(self, key: int, where: str = "key") -> str:
        """Name of a variable in words. Raises InputError, beginning with `where`, for an unknown key."""
        if key in self._name:
            return self._name[key]
        # By hand: GTSAM fails on letters that are no ASCII.
        letter = chr(key >> _INDEX_BITS) if 0 <= key < 1 << 64 else ""
        index = key & ((1 << _INDEX_BITS) - 1)
        shown = f"{letter}{index}" if letter.isascii() and letter.isalpha() else str(key)
        alike = [k for k in self._name if chr(gtsam.symbolChr(k)) == letter]
        hint = ""
        if alike:
            nearest = min(alike, key=lambda k: abs(int(gtsam.symbolIndex(k)) - index))
            hint = f"; is {gtsam.DefaultKeyFormatter(nearest)}, the {self._name[nearest]}, meant?"
        elif letter == Kind.LANDMARK.value:
            hint = "; factors on terrain points are not supported yet"
        elif letter in {kind.value for kind in Kind}:
            hint = "; with this model and sharing there is no such variable"
        raise InputError(
            f"{where}: expected keys of graph_keys(traverse, options): {self._summary()}; found {shown}{hint}"
        )

    def _summary(self) -> str:
        parts = [f"{len(self._stop)} masts", f"angles of {len(self._frame)} frames"]
        return ", ".join([*parts, *(self._name[v.key] for v in self._rig.variables[:_NAMED])])

    def _name_of(self, v: RigVariable) -> str:
        return f"{_CALLED[v.quantity]}{self._rig.owner(v)}"

    def _rig_key(self, quantity: Quantity, camera: str | None, stop: str | None, image: str | None) -> int:
        called = _CALLED[quantity]
        variables = self._rig.of[quantity]
        if not variables:
            raise InputError(
                f"{called}: expected it to be free, found it fixed; Sharing({quantity}=...) frees it"
            )
        fitting = np.unique(self._rig.place(quantity)[self._sites(quantity, camera, stop, image)])
        if len(fitting) == 1:
            return variables[int(fitting[0])].key
        among = [self._name[variables[int(i)].key] for i in fitting] or [self._name[v.key] for v in variables]
        owner = ", ".join(
            f"{what} {name!r}"
            for what, name in (("camera", camera), ("stop", stop), ("image", image))
            if name is not None
        )
        raise InputError(
            f"{called}: expected one of {some_of(among)}; found {owner or 'nothing that says which'}"
        )

    def _sites(
        self, quantity: Quantity, camera: str | None, stop: str | None, image: str | None
    ) -> BoolArray:
        """Mask of the images (of pan_T_tilt and encoders: stops) of a camera, of a stop, or of one image."""
        t = self._traverse
        axis = quantity in {"pan_T_tilt", "encoders"}
        sites = np.ones(len(t.stops if axis else t.images), dtype=bool)
        for what, wanted, names, of_site in (
            ("camera", camera, [eye.name for eye in t.rig.eyes], t.image_eye),
            ("stop", stop, list(self._stop), np.arange(len(t.stops)) if axis else t.image_stop),
            ("image", image, [one.id for one in t.images], np.arange(len(t.images))),
        ):
            if wanted is not None:
                if wanted not in names:
                    raise InputError(expected_one_of(what, wanted, names))
                sites &= of_site == names.index(wanted)
        return sites
