"""A pinhole, and a lens that is radial alone, as vectors of the CAHV family; exactly or not at all."""

import numpy as np

from pancam_graph.base.errors import CameraError
from pancam_graph.cameras._brown import Brown
from pancam_graph.cameras._cahv import CAHV, CAHVOR
from pancam_graph.cameras._camera import Camera

__all__ = ["as_cahv"]


def as_cahv(camera: Camera) -> CAHV:
    """The same camera as a model of the CAHV family, vectors in the camera's own frame.

    A camera of the family is returned as it is. A pinhole is a CAHV: C = 0, A along z, H and V the rows of K.
    A Brown lens with k1 and k2 alone is a CAHVOR with O = A and R = (0, k1, k2): with w = z, t is the
    squared radius of Brown 1971, and d' differs from d in x and y alone.

    Raises CameraError for a Brown lens with p1, p2 or k3, of which CAHVOR has no equal.
    """
    if isinstance(camera, CAHV):
        return camera
    h, v, a = camera.pinhole.calibration_matrix
    linear = CAHV(width_px=camera.width_px, height_px=camera.height_px, C=np.zeros(3), A=a, H=h, V=v)
    if not isinstance(camera, Brown) or not any(camera.distortion):
        return linear
    k1, k2, p1, p2, k3 = camera.distortion
    if p1 or p2 or k3:
        raise CameraError(
            f"distortion: expected k1 and k2 alone, all that CAHVOR can say, found p1 {p1:g}, p2 {p2:g}, "
            f"k3 {k3:g}"
        )
    return CAHVOR(
        width_px=camera.width_px,
        height_px=camera.height_px,
        C=linear.C,
        A=a,
        H=h,
        V=v,
        O=a,
        R=np.array([0.0, k1, k2]),
    )
