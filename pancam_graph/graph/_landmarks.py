"""Landmarks as variables of the graph, with GTSAM's own projection factors.

The other way to treat landmarks is to eliminate them (`pancam_graph.elimination`).
"""

from collections.abc import Sequence

import gtsam
import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.cameras import without_field
from pancam_graph.factors import Fixed, Key, camera_projection_factor
from pancam_graph.graph._given import GivenFactor, seated
from pancam_graph.graph._keys import Kind, key_of, read_variable
from pancam_graph.graph._native_calibrations import NativeCalibrations
from pancam_graph.graph._soft import SoftTemplate
from pancam_graph.landmarks import SQUARED, Loss, Measurements

__all__ = ["ExplicitLandmarks"]


class ExplicitLandmarks:
    """One Point3 variable `L` per landmark, one factor per observation: native ones of pinholes.

    GTSAM's projections have no distortion: observations of other cameras are factors of this package. A
    landmark behind a camera has a large constant cost, so the optimiser rejects the step. GTSAM's factor of a
    free calibration lacks this, and the caller must check for such landmarks.
    """

    def __init__(self, template: SoftTemplate, measurements: Measurements) -> None:
        self.template = template
        self.measurements = measurements
        self._plain_px = template.without_field(measurements.image, measurements.uv_px)
        self.calibrations = NativeCalibrations(template.rig_variables)
        rig = template.traverse.rig
        self._calibration = [
            gtsam.Cal3_S2(p.fx_px, p.fy_px, p.skew_px, p.cx_px, p.cy_px) for p in rig.pinholes
        ]
        self._lens = [without_field(eye.camera).with_unit_calibration() for eye in rig.eyes]

    @staticmethod
    def key(landmark: int) -> int:
        """Key of a landmark."""
        return key_of(Kind.LANDMARK, landmark)

    def beside_landmarks(self, given: Sequence[GivenFactor] = ()) -> gtsam.NonlinearFactorGraph:
        """All factors except those of observations: the template's and the caller's."""
        template_factors = self.template.factors(apart=True)
        given = self.template.believed(given)
        seats = self.calibrations.seats(self.template.seats(given))
        placed = (seated(one, seats) for one in given)
        graph = self.calibrations.in_place(template_factors.graph)
        for factor in placed:
            if factor is not None:
                graph.push_back(factor)
        return graph

    def factors(self, accepted: BoolArray, loss: Loss = SQUARED) -> gtsam.NonlinearFactorGraph:
        """A factor for each accepted observation."""
        graph = gtsam.NonlinearFactorGraph()
        m, eye = self.measurements, self.template.traverse.image_eye
        isotropic: dict[float, gtsam.noiseModel.Base] = {}  # one model serves all pinholes of one sigma
        for i in np.flatnonzero(accepted):
            w = m.whitening[i]
            if w[0, 1] == w[1, 0] == 0 and w[0, 0] == w[1, 1]:
                noise = isotropic.get(w[0, 0])
                if noise is None:
                    noise = loss.noise_model(gtsam.noiseModel.Isotropic.Sigma(2, 1 / w[0, 0]))
                    isotropic[w[0, 0]] = noise
            else:
                # Not "smart": GTSAM takes a matrix with nothing above its diagonal for a diagonal one.
                noise = loss.noise_model(gtsam.noiseModel.Gaussian.SqrtInformation(w, False))
            image = int(m.image[i])
            camera, landmark = self.template.camera_key(image), self.key(int(m.landmark[i]))
            if self.template.lenses.row[image] >= 0:
                graph.push_back(
                    camera_projection_factor(
                        noise,
                        Key(landmark),
                        Key(camera),
                        Key(self.calibrations.key(image))
                        if self.calibrations.any
                        else Fixed(self._calibration[eye[image]].vector()),
                        lens=self._lens[eye[image]],
                        uv_px=self._plain_px[i],
                    )
                )
            elif self.calibrations.any:
                calibration = self.calibrations.key(image)
                graph.push_back(
                    gtsam.GeneralSFMFactor2Cal3_S2(self._plain_px[i], noise, camera, landmark, calibration)
                )
            else:
                graph.push_back(
                    gtsam.GenericProjectionFactorCal3_S2(
                        self._plain_px[i],
                        noise,
                        camera,
                        landmark,
                        self._calibration[eye[image]],
                        False,
                        False,
                    )
                )
        return graph

    def proximal_factors(
        self, points_m: FloatArray, sigma_m: FloatArray, which: BoolArray
    ) -> gtsam.NonlinearFactorGraph:
        """Priors on the landmarks `which` at their places `points_m`, with sigmas (landmarks,), metres.

        The caller centres them anew in every round, so they regularise the system without bias.
        """
        graph = gtsam.NonlinearFactorGraph()
        for j in np.flatnonzero(which):
            noise = gtsam.noiseModel.Isotropic.Sigma(3, float(sigma_m[j]))
            graph.push_back(gtsam.PriorFactorPoint3(self.key(int(j)), points_m[j], noise))
        return graph

    def with_landmarks(self, cameras: gtsam.Values, points_m: FloatArray, present: BoolArray) -> gtsam.Values:
        """The cameras' values together with those of the landmarks that take part."""
        values = self.calibrations.values_of(cameras)
        self.insert_points(values, points_m, present)
        return values

    def insert_points(self, values: gtsam.Values, points_m: FloatArray, present: BoolArray) -> None:
        """Add the landmarks (landmarks, 3) that take part."""
        for j in np.flatnonzero(present):
            values.insert(self.key(int(j)), points_m[j])

    def only_cameras(self, values: gtsam.Values) -> gtsam.Values:
        """The template's variables, out of values that hold landmarks too."""
        kept, free = gtsam.Values(), self.calibrations.free_entries(values)
        for key in self.template.linkage.key:
            kept.insert(key, free[key] if key in free else read_variable(values, key))
        return kept

    def retract(self, cameras: gtsam.Values, step: gtsam.VectorValues, share: float) -> gtsam.Values:
        """The template's variables moved by a share of a step that may move landmarks too."""
        camera_step, step = gtsam.VectorValues(), self.calibrations.step(step)
        for key in cameras.keys():  # noqa: SIM118  gtsam.Values is not a dictionary
            camera_step.insert(key, share * step.at(key))
        return cameras.retract(camera_step)

    def points_m(self, values: gtsam.Values, present: BoolArray) -> FloatArray:
        """Landmarks (landmarks, 3) from the values; NaN for those that do not take part."""
        points = np.full((len(present), 3), np.nan)
        for j in np.flatnonzero(present):
            points[j] = values.atPoint3(self.key(int(j)))
        return points
