"""Camera models: published test vectors, round trips, Jacobians, domains, P to K, R, C."""

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pancam_graph.base.errors import CameraError
from pancam_graph.base.geometry import HEAD_R_FORWARD_CAMERA, FloatArray
from pancam_graph.cameras import (
    CAHV,
    CAHVORE,
    FIELD_SHAPE,
    Brown,
    Camera,
    FieldCamera,
    Pinhole,
    decompose_projection,
    projection_matrix,
)
from support.published_cameras import (
    LINEAR_PIXEL_B,
    MODEL_A,
    MODEL_B,
    MODEL_C,
    PIXEL_B,
    PIXELS_C,
    POINT_B,
    POINTS_C,
)

# Their pixels in the tests were computed by two independent programs.
PINHOLE = Pinhole(
    width_px=640, height_px=480, fx_px=500.0, fy_px=510.0, cx_px=321.0, cy_px=237.0, skew_px=2.0
)
BROWN = Brown(
    width_px=640,
    height_px=480,
    fx_px=500.0,
    fy_px=510.0,
    cx_px=321.0,
    cy_px=237.0,
    distortion=(-0.2, 0.05, 1e-3, -2e-3, 0.01),
)
FISHEYES = [
    CAHVORE(
        width_px=1024,
        height_px=1024,
        **{n: getattr(MODEL_B, n) for n in "CAHVOR"},
        E=np.array([0.003, -0.01, 0.002]),
        linearity=k,
    )
    for k in (0.0, -0.5, 1.0)
]
CAHV_B = CAHV(width_px=1024, height_px=1024, C=MODEL_B.C, A=MODEL_B.A, H=MODEL_B.H, V=MODEL_B.V)
# Fields of some pixels, a hundred times those of real cameras.
BENT = [
    FieldCamera(
        width_px=lens.width_px,
        height_px=lens.height_px,
        lens=lens,
        field_px=np.random.default_rng(seed).normal(scale=4.0, size=FIELD_SHAPE),
    )
    for seed, lens in enumerate((BROWN, MODEL_C))
]
ALL = [PINHOLE, BROWN, CAHV_B, MODEL_A, MODEL_B, MODEL_C, *FISHEYES, *BENT]
IDS = [
    "pinhole",
    "brown",
    "cahv",
    "cahvor-a",
    "cahvor-b",
    "cahvore-c",
    "equidistant",
    "asin",
    "perspective-e",
    "brown-field",
    "cahvore-field",
]


def pixel(camera: Camera, point: tuple[float, float, float]) -> FloatArray:
    uv, valid = camera.project(np.array([point]))
    assert valid.all()
    return np.asarray(uv[0])


def test_pixels_of_published_models() -> None:
    a = pixel(MODEL_A, (-0.593194, 0.294442, 0.545509))
    assert a == pytest.approx([599.66607394, 131.22968783], abs=5e-9)
    assert pixel(MODEL_B, POINT_B) == pytest.approx(PIXEL_B, abs=5e-9)
    assert pixel(CAHV_B, POINT_B) == pytest.approx(LINEAR_PIXEL_B, abs=5e-8)
    for point, expected in zip(POINTS_C, PIXELS_C, strict=True):
        assert pixel(MODEL_C, point) == pytest.approx(expected, abs=5e-7)


def test_published_intrinsics() -> None:
    for camera, expected in (
        (MODEL_A, (1603.740754, 1603.134816, 375.790532, 259.023018)),
        (MODEL_B, (1220.314964, 1219.933214, 509.344260, 517.318012)),
    ):
        found = (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px)
        assert found == pytest.approx(expected, abs=5e-7)


def scene(camera: Camera, n: int = 60, seed: int = 0) -> FloatArray:
    """Points that the camera sees, from 1 m to 10 km, over the whole image."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform(0, 1, (n, 2)) * [camera.width_px - 1, camera.height_px - 1]
    rays = camera.unproject(uv)
    assert rays.valid.all()
    return rays.origin_m + rays.direction * np.exp(rng.uniform(0, np.log(1e4), (n, 1)))


@pytest.mark.parametrize("camera", ALL, ids=IDS)
def test_round_trip(camera: Camera) -> None:
    rng = np.random.default_rng(1)
    uv = rng.uniform(0, 1, (200, 2)) * [camera.width_px - 1, camera.height_px - 1]
    rays = camera.unproject(uv)
    assert rays.valid.all()
    assert np.linalg.norm(rays.direction, axis=1) == pytest.approx(1.0, abs=1e-14)
    for distance in (1.0, 30.0, 1e5):
        back, valid = camera.project(rays.origin_m + distance * rays.direction)
        assert valid.all()
        assert back == pytest.approx(uv, abs=1e-8)


@pytest.mark.parametrize("camera", ALL, ids=IDS)
def test_jacobians_against_differences(camera: Camera) -> None:
    points = scene(camera)
    _, jacobian, _ = camera.project_with_jacobian(points)
    distance = np.linalg.norm(points, axis=1)
    h = 1e-6 * distance
    for axis in range(3):
        step = np.eye(3)[axis] * h[:, None]
        numeric = (camera.project(points + step)[0] - camera.project(points - step)[0]) / (2 * h[:, None])
        scale = np.linalg.norm(jacobian, axis=(1, 2))[:, None]
        assert np.abs(numeric - jacobian[:, :, axis]).max(initial=0, where=scale > 0) < 1e-5 * scale.max()
        assert (np.abs(numeric - jacobian[:, :, axis]) / scale).max() < 1e-5

    uv, _ = camera.project(points)
    _, d_origin, d_direction = camera.unproject_with_jacobian(uv)
    for axis in range(2):
        step = np.eye(2)[axis] * 1e-2
        plus, minus = camera.unproject(uv + step), camera.unproject(uv - step)
        numeric = (plus.direction - minus.direction) / 2e-2
        assert numeric == pytest.approx(d_direction[:, :, axis], abs=2e-9)
        numeric = (plus.origin_m - minus.origin_m) / 2e-2
        assert numeric == pytest.approx(d_origin[:, :, axis], abs=2e-9)


@pytest.mark.parametrize("side_px", [0, -1, 1_000_001, 10**400])
def test_no_image_has_such_a_side(side_px: int) -> None:
    with pytest.raises(CameraError, match="image size: expected at"):
        Pinhole(width_px=side_px, height_px=4, fx_px=1.0, fy_px=1.0, cx_px=0.0, cy_px=0.0)


@pytest.mark.parametrize("camera", ALL[: -len(BENT)], ids=IDS[: -len(BENT)])  # a field is in pixels
def test_another_calibration_leaves_all_but_the_pixels(camera: Camera) -> None:
    """Pixels in units of K are the same before and after, distortion included."""
    before = camera.pinhole.calibration_matrix
    after = before * [[1.02, 1.0, 1.01], [1.0, 0.98, 0.99], [1.0, 1.0, 1.0]] + [
        [0, 0.7, 0],
        [0, 0, 0],
        [0, 0, 0],
    ]
    changed = camera.with_calibration(after)
    assert type(changed) is type(camera)
    assert changed.pinhole.calibration_matrix == pytest.approx(after, rel=1e-13, abs=1e-11)
    points = scene(camera)
    unit = []
    for one, k in ((camera, before), (changed, after)):
        uv, valid = one.project(points)
        assert valid.all()
        unit.append(np.linalg.solve(k, np.column_stack([uv, np.ones(len(uv))]).T))
    assert unit[1] == pytest.approx(unit[0], abs=1e-12)
    with pytest.raises(CameraError, match="focal length"):
        camera.with_calibration(np.diag([-1.0, 1.0, 1.0]) @ after)


def test_jacobian_on_the_optical_axis_of_a_fisheye() -> None:
    camera = FISHEYES[0]
    point = camera.C + 5 * camera.O
    _, jacobian, valid = camera.project_with_jacobian(point[None])
    assert valid.all()
    numeric = np.column_stack(
        [
            (camera.project((point + s)[None])[0][0] - camera.project((point - s)[None])[0][0]) / 2e-5
            for s in np.eye(3) * 1e-5
        ]
    )
    assert jacobian[0] == pytest.approx(numeric, rel=1e-6, abs=1e-4)


def test_calibration_jacobian() -> None:
    points = scene(BROWN)
    _, jacobian, _ = BROWN.project_with_calibration_jacobian(points)
    for column, name in enumerate(("fx_px", "fy_px", "skew_px", "cx_px", "cy_px")):
        plus, minus = ({f: getattr(BROWN, f) for f in BROWN.__dataclass_fields__} for _ in range(2))
        plus[name] += 0.5
        minus[name] -= 0.5
        numeric = Brown(**plus).project(points)[0] - Brown(**minus).project(points)[0]
        assert numeric == pytest.approx(jacobian[:, :, column], abs=1e-9)


@pytest.mark.parametrize("camera", ALL, ids=IDS)
def test_behind_the_camera_is_invalid_and_finite(camera: Camera) -> None:
    rays = camera.unproject(np.array([[camera.width_px / 2, camera.height_px / 2]]))
    behind = rays.origin_m - 5 * rays.direction
    uv, jacobian, valid = camera.project_with_jacobian(np.vstack([behind, rays.origin_m]))
    assert not valid.any()
    assert np.isfinite(uv).all()
    assert np.isfinite(jacobian).all()


def test_brown_agrees_with_opencv() -> None:
    cv2 = pytest.importorskip("cv2")
    points = scene(BROWN)
    expected, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), BROWN.calibration_matrix, np.array(BROWN.distortion)
    )
    assert BROWN.project(points)[0] == pytest.approx(expected[:, 0], abs=1e-9)


def test_brown_beyond_its_fold_is_invalid() -> None:
    camera = Brown(
        width_px=640,
        height_px=480,
        fx_px=300.0,
        fy_px=300.0,
        cx_px=320.0,
        cy_px=240.0,
        distortion=(-0.3, 0, 0, 0, 0),
    )
    # x (1 - 0.3 x^2) peaks at x = 1.054 with the value 0.703
    rays = camera.unproject(np.array([[320 + 300 * 0.70, 240.0], [320 + 300 * 0.75, 240.0]]))
    assert rays.valid.tolist() == [True, False]


@pytest.mark.parametrize("camera", [CAHV_B, MODEL_A, MODEL_B, MODEL_C], ids=["cahv", "a", "b", "c"])
def test_cahv_family_in_its_camera_frame(camera: CAHV) -> None:
    own, frame_T_camera = camera.split()
    points = scene(camera)
    uv, _ = camera.project(points)
    assert own.C == pytest.approx(np.zeros(3), abs=1e-15)
    assert own.A == pytest.approx([0, 0, np.linalg.norm(camera.A)], abs=1e-12)
    inside = np.array([frame_T_camera.transformTo(p) for p in points])
    assert own.project(inside)[0] == pytest.approx(uv, abs=1e-7)
    back = own.transformed(frame_T_camera)
    for name in camera._vector_names():
        assert getattr(back, name) == pytest.approx(getattr(camera, name), abs=1e-12 * 4000)


def test_pinhole_of_a_cahv_is_the_same_camera() -> None:
    own, frame_T_camera = CAHV_B.split()
    points = scene(CAHV_B)
    inside = np.array([frame_T_camera.transformTo(p) for p in points])
    assert CAHV_B.pinhole.project(inside)[0] == pytest.approx(CAHV_B.project(points)[0], abs=1e-8)
    assert own.pinhole.calibration_matrix == pytest.approx(CAHV_B.pinhole.calibration_matrix, abs=1e-9)


finite = st.floats(-1, 1)


@settings(max_examples=40, deadline=None)
@given(
    w=st.tuples(finite, finite, finite),
    c=st.tuples(finite, finite, finite),
    f=st.floats(50, 2e4),
    aspect=st.floats(0.5, 2),
    x0=st.floats(-500, 3000),
    skew=st.floats(-20, 20),
    scale=st.sampled_from([1.0, -1.0, 1e-3, -250.0]),
)
def test_projection_matrix_round_trip(
    w: tuple[float, ...], c: tuple[float, ...], f: float, aspect: float, x0: float, skew: float, scale: float
) -> None:
    k = np.array([[f, skew, x0], [0, f * aspect, x0 / 2], [0, 0, 1]])
    rotation = gtsam.Rot3.Expmap(3 * np.array(w)).matrix()
    centre = 100 * np.array(c)
    k2, r2, c2 = decompose_projection(scale * projection_matrix(k, rotation, centre))
    assert k2 == pytest.approx(k, rel=1e-9, abs=1e-8 * f)
    assert r2 == pytest.approx(rotation, abs=1e-9)
    assert c2 == pytest.approx(centre, abs=1e-6)
    assert np.diag(k2).min() > 0


def test_projection_matrix_refusals() -> None:
    p = projection_matrix(PINHOLE.calibration_matrix, HEAD_R_FORWARD_CAMERA.T, np.zeros(3))
    flat = p.copy()
    flat[2] = 0
    with pytest.raises(CameraError, match="third row"):
        decompose_projection(flat)
    rank2 = p.copy()
    rank2[1] = rank2[0]
    with pytest.raises(CameraError, match="rank 3"):
        decompose_projection(rank2)
    with pytest.raises(CameraError, match="finite"):
        decompose_projection(np.full((3, 4), np.nan))


def test_refusals_name_the_entry() -> None:
    size = {"width_px": 10, "height_px": 10}
    with pytest.raises(CameraError, match="focal length"):
        Pinhole(**size, fx_px=0.0, fy_px=1.0, cx_px=0.0, cy_px=0.0)
    with pytest.raises(CameraError, match="skew_px"):
        Pinhole(**size, fx_px=1.0, fy_px=1.0, cx_px=0.0, cy_px=0.0, skew_px=np.nan)
    with pytest.raises(CameraError, match="image size"):
        Pinhole(width_px=0, height_px=10, fx_px=1.0, fy_px=1.0, cx_px=0.0, cy_px=0.0)
    with pytest.raises(CameraError, match="A x H"):
        CAHV(**size, C=np.zeros(3), A=np.array([0, 0, 1.0]), H=np.array([0, 0, 5.0]), V=np.array([0, 9.0, 5]))
    with pytest.raises(CameraError, match="mirrored"):
        CAHV(
            **size, C=np.zeros(3), A=np.array([0, 0, 1.0]), H=np.array([0, 9.0, 5.0]), V=np.array([9.0, 0, 5])
        )
