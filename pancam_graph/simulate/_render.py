"""Panoramas as image files would have them, with truth: a mast rig driven over a textured world."""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.base.options import options_of
from pancam_graph.base.threads import in_parallel
from pancam_graph.data import Traverse
from pancam_graph.rigs import Rig
from pancam_graph.simulate import _rays
from pancam_graph.simulate._drive import (
    TelemetryStart,
    Truth,
    claimed_rig,
    flexed,
    make_traverse,
    panorama,
    path,
    stand,
    telemetry,
)
from pancam_graph.simulate._rays import Deck, Scene
from pancam_graph.simulate._scene import make_deck, make_scene, slopes
from pancam_graph.simulate._sensor import HALO_PX, GreyImage, expose
from pancam_graph.simulate._simulation_options import RenderOptions

__all__ = ["Rendering", "render"]

_OVERLAP = 0.2  # of neighbouring frames, as a share of the widest eye's field
_BELOW_HORIZON = 0.4  # where the row looks, as a share of the field down
_BAND_PX = 128  # rows that one thread renders at a time
_KEPT_PX = 8_000_000  # lines of sight that are kept from image to image
_RIM_PIXEL_RAD = 1e-3  # width of a pixel whose neighbour sees nothing
_SEEN = 0.03  # contrast of neighbours from which on an edge between them is smoothed
_EDGE_RAYS = 2  # along each side of a pixel that lies on an edge


class _Traced(NamedTuple):
    """What rays (n,) met."""

    light: FloatArray
    distance_m: FloatArray
    ground_m: FloatArray
    edge: IntArray


def _trace(
    scene: Scene,
    deck: Deck,
    origin_m: FloatArray,
    direction: FloatArray,
    pixel_rad: FloatArray,
    below: IntArray | None = None,
    over: tuple[FloatArray, FloatArray] | None = None,
    *,
    lit: bool = True,
) -> _Traced:
    """Follow rays; `below` and `over` name rays under them, of these or of others with their distances."""
    n = len(direction)
    out = _Traced(np.empty(n), np.empty(n), np.empty(n), np.empty(n, dtype=np.int64))
    below = np.full(n, -1) if below is None else below
    rays = (origin_m, np.ascontiguousarray(direction), pixel_rad, below)
    helpers = over or (rays[1], out.ground_m)
    _rays.trace(scene, deck, *rays, *helpers, lit, out.light, out.distance_m, out.ground_m, out.edge)
    return out


@dataclass(frozen=True)
class _View:
    """Whole rows of an image: origins (1 or h w, 3), directions (h, w, 3), widths of the pixels (h, w)."""

    scene: Scene
    deck: Deck
    origin_m: FloatArray
    direction: FloatArray
    pixel_rad: FloatArray

    def light(self) -> FloatArray:
        """Radiance (h, w) of each pixel's middle, and of pixels on edges the mean over several rays."""
        rows, columns = self.pixel_rad.shape
        direction, pixel = self.direction.reshape(-1, 3), self.pixel_rad.ravel()
        below = np.arange(columns, len(pixel) + columns)
        below[-columns:] = -1
        traced = _trace(self.scene, self.deck, self.origin_m, direction, pixel, below)
        shape = rows, columns
        rough = np.flatnonzero(
            _edges(traced.edge.reshape(shape), traced.distance_m.reshape(shape), traced.light.reshape(shape))
        )
        light = traced.light
        steps = (np.arange(_EDGE_RAYS) + 0.5) / _EDGE_RAYS - 0.5
        down = 0.5 * (direction[rough + columns] - direction[rough - columns])
        right = 0.5 * (direction[rough + 1] - direction[rough - 1])
        finer = np.stack([direction[rough] + p * down + q * right for p in steps for q in steps], axis=1)
        finer /= np.linalg.norm(finer, axis=-1, keepdims=True)
        rays = _EDGE_RAYS**2
        again = _trace(
            self.scene,
            self.deck,
            self.origin_m if len(self.origin_m) == 1 else np.repeat(self.origin_m[rough], rays, axis=0),
            finer.reshape(-1, 3),
            np.repeat(pixel[rough] / _EDGE_RAYS, rays),
            np.repeat(rough + columns, rays),
            (direction, traced.ground_m),
        )
        light[rough] = again.light.reshape(-1, rays).mean(axis=1)
        return light.reshape(shape)


def _edges(edge: IntArray, distance_m: FloatArray, light: FloatArray) -> BoolArray:
    """Which pixels (h, w) lie on an edge that is seen; none of the outermost, none beside one not traced."""
    out = np.zeros(edge.shape, dtype=bool)
    inner = slice(1, -1), slice(1, -1)
    rough, whole = out[inner], edge[inner] != -2
    for a, b in ((0, 1), (2, 1), (1, 0), (1, 2)):
        beside = slice(a, a + len(rough)), slice(b, b + rough.shape[1])
        far, away = distance_m[beside], distance_m[inner]
        with np.errstate(invalid="ignore"):  # the sky from the sky
            other = (edge[beside] != edge[inner]) | (np.abs(far - away) > 0.04 * away + 0.02 * far)
        sharp = np.abs(light[beside] - light[inner]) > _SEEN * (light[beside] + light[inner])
        rough |= other & sharp
        whole &= edge[beside] != -2
    rough &= whole
    return out


@dataclass(frozen=True, kw_only=True, eq=False)
class Rendering:
    """A traverse of images as a solver gets it, what it should find, and the images, rendered when asked."""

    traverse: Traverse
    """At the disturbed telemetry, without observations; its image files are named but not written."""
    truth: Truth
    """Without landmarks: ask `points` for those of any pixels."""
    telemetry_start: TelemetryStart
    options: RenderOptions
    seed: int
    _scene: Scene
    _sights: dict[int, tuple[FloatArray, FloatArray, FloatArray]] = field(default_factory=dict)

    def image(self, row: int) -> GreyImage:
        """Image of that row of the traverse, (height, width), 8 bits or 12 in 16.

        The same image at each call, whatever was rendered before and on however many threads.
        """
        eye = int(self.traverse.image_eye[row])
        camera = self.truth.rig.eyes[eye].camera
        rotation, centre = self._camera(row)
        light = np.empty((camera.height_px + 2 * HALO_PX, camera.width_px + 2 * HALO_PX))

        def band(begin: int, end: int) -> None:
            # Each band is rendered with what the optics smear into it, and stands for itself.
            rows = np.arange(begin - HALO_PX, end + HALO_PX)
            origin, direction, pixel = self._band_rays(eye, rows)
            view = _View(
                self._scene, self._deck(row), centre + origin @ rotation.T, direction @ rotation.T, pixel
            )
            part = view.light()
            inner = slice(HALO_PX if begin else 0, len(part) - (HALO_PX if end < camera.height_px else 0))
            light[begin + inner.start : begin + inner.stop] = part[inner]

        in_parallel(band, camera.height_px, grain=_BAND_PX)
        # A stream of its own for each image: its noise does not depend on what was rendered before.
        return expose(light, self.options, np.random.default_rng([self.seed, row, 1]))

    def points(self, row: int, uv_px: FloatArray) -> tuple[FloatArray, BoolArray]:
        """What pixels (n, 2) of an image see: points in the world (n, 3), and which see any (n,).

        A point in the sky, or of a pixel outside the camera's domain, is not meaningful.
        """
        rotation, centre = self._camera(row)
        camera = self.truth.rig.eyes[int(self.traverse.image_eye[row])].camera
        rays, beside = camera.unproject(uv_px), camera.unproject(uv_px + np.array([1.0, 0.0]))
        pixel = np.linalg.norm(beside.direction - rays.direction, axis=1)
        pixel = np.where(rays.valid & beside.valid, pixel, _RIM_PIXEL_RAD)
        origin, direction = centre + rays.origin_m @ rotation.T, rays.direction @ rotation.T
        traced = _trace(self._scene, self._deck(row), origin, direction, pixel, lit=False)
        distance = traced.distance_m
        hit = np.isfinite(distance) & rays.valid
        return origin + np.where(hit, distance, 0.0)[:, None] * direction, hit

    def depth_m(self, row: int) -> FloatArray:
        """Depth (height, width) of what each pixel of an image sees: along the camera's axis, metres.

        NaN in the sky and outside the camera's domain. Truth for a dense match: see `points`.
        """
        rotation, centre = self._camera(row)
        camera = self.truth.rig.eyes[int(self.traverse.image_eye[row])].camera
        v, u = np.mgrid[: camera.height_px, : camera.width_px].astype(float)
        depth = np.empty(v.shape)

        def band(begin: int, end: int) -> None:
            pixels = np.stack([u[begin:end].ravel(), v[begin:end].ravel()], axis=1)
            points, hit = self.points(row, pixels)
            along = (points - centre) @ rotation[:, 2]
            depth[begin:end] = np.where(hit, along, np.nan).reshape(end - begin, -1)

        in_parallel(band, camera.height_px, grain=_BAND_PX)
        return depth

    def heights_m(self, xy_m: FloatArray, footprint_m: float) -> FloatArray:
        """Height of the ground (n,) in the world at x and y (n, 2), rocks and stones on it included.

        The deck is no ground. Stones smaller than `footprint_m`, metres, are left out, as a pixel of that
        width leaves them out. NaN beyond the world's edge. Raises InputError for a footprint that is not
        above 0.
        """
        above, distance, _ = self._from_above(xy_m, footprint_m, lit=False)
        return np.where(np.isfinite(distance), above - distance, np.nan)

    def light_from_above(self, xy_m: FloatArray, footprint_m: float) -> FloatArray:
        """Radiance (n,) that goes up from x and y (n, 2), as an orbiter sees it; see `heights_m`.

        Shadows are those of the drive's images. Detail finer than the footprint is left out, not averaged.
        """
        _, distance, light = self._from_above(xy_m, footprint_m, lit=True)
        return np.where(np.isfinite(distance), light, np.nan)

    def _from_above(
        self, xy_m: FloatArray, footprint_m: float, *, lit: bool
    ) -> tuple[float, FloatArray, FloatArray]:
        """A height above all, and the distances down from there (n,) and the light (n,) at x and y (n, 2)."""
        if not footprint_m > 0:
            raise InputError(f"rendering: footprint_m: expected a number above 0, found {footprint_m}")
        places = np.asarray(xy_m, dtype=float).reshape(-1, 2)
        above = max(self._scene.top_m, self._scene.rock_top_m) + 1.0
        down, deck = np.array([0.0, 0.0, -1.0]), self._deck(0, seen=False)
        distance, light = np.empty(len(places)), np.empty(len(places))

        def some(begin: int, end: int) -> None:
            n = end - begin
            ground = _rays.heights(self._scene, places[begin:end])
            from_m = np.column_stack([places[begin:end], np.full(n, above)])
            width = footprint_m / np.maximum(above - ground, 1e-3)
            traced = _trace(self._scene, deck, from_m, np.tile(down, (n, 1)), width, lit=lit)
            distance[begin:end], light[begin:end] = traced.distance_m, traced.light

        in_parallel(some, len(places), grain=_BAND_PX * _BAND_PX)
        return above, distance, light

    def _camera(self, row: int) -> tuple[FloatArray, FloatArray]:
        """world_R_camera and the camera's place, in truth."""
        true = replace(self.traverse, rig=self.truth.rig)
        rotation, centre = true.camera_poses(
            self.truth.world_T_mast, self.truth.pan_tilt_rad, self.truth.flex
        )
        return np.ascontiguousarray(rotation[row]), np.ascontiguousarray(centre[row])

    def _deck(self, row: int, *, seen: bool = True) -> Deck:
        stop = int(self.traverse.frame_stop[self.traverse.image_frame[row]])
        pose = self.truth.world_T_mast[stop]
        return make_deck(self.truth.rig.mast_height_m, pose, seen=seen and self.options.deck)

    def _band_rays(self, eye: int, rows: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Lines of sight of whole rows, a margin on both sides included, in the camera frame.

        Origins (1 or h w, 3), directions (h, w, 3) and the pixels' widths (h, w) in radians, 0 where there is
        no line of sight.
        """
        camera = self.truth.rig.eyes[eye].camera
        if sum(e.camera.width_px * e.camera.height_px for e in self.truth.rig.eyes) > _KEPT_PX:
            return self._sight(eye, rows)
        if eye not in self._sights:
            self._sights[eye] = self._sight(eye, np.arange(-HALO_PX, camera.height_px + HALO_PX))
        origin, direction, pixel = self._sights[eye]
        part = slice(int(rows[0]) + HALO_PX, int(rows[-1]) + HALO_PX + 1)
        if len(origin) > 1:
            origin = origin.reshape(*pixel.shape, 3)[part].reshape(-1, 3)
        return origin, direction[part], pixel[part]

    def _sight(self, eye: int, rows: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        camera = self.truth.rig.eyes[eye].camera
        columns = np.arange(-HALO_PX, camera.width_px + HALO_PX)
        v, u = np.meshgrid(rows.astype(float), columns.astype(float), indexing="ij")
        rays = camera.unproject(np.stack([u, v], axis=-1).reshape(-1, 2))
        origin = rays.origin_m if camera.pupil_moves else rays.origin_m[:1]
        direction = rays.direction.reshape(*u.shape, 3)
        valid = rays.valid.reshape(u.shape)
        pixel = np.linalg.norm(np.diff(direction, axis=1, append=direction[:, -2:-1]), axis=2)
        beside = np.append(valid[:, 1:], valid[:, -2:-1], axis=1)
        pixel = np.where(valid, np.where(beside, pixel, _RIM_PIXEL_RAD), 0.0)
        return np.ascontiguousarray(origin), direction, pixel


def render(rig: Rig, options: RenderOptions | None = None, *, seed: int = 0) -> Rendering:
    """Drive `rig` over a random world and take panoramas. The same arguments give the same bytes.

    World, drive, errors of telemetry and of the rig that the traverse claims, and sensor noise are drawn
    independently of each other. Every pixel is traced along the ray of the camera's own model, and all that
    is seen lies on the surface that `Rendering.points` returns. Raises InputError for a negative seed.
    """
    options = options_of(RenderOptions, options, "render")
    if seed < 0:
        raise InputError(f"simulation: seed: expected 0 or more, found {seed}")
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(5)]
    rng_world, rng_drive, rng_telemetry, rng_rig, rng_flex = streams
    xy, heading = path(options, rng_drive)
    scene = make_scene(options, xy, rng_world)
    ground, slope = slopes(scene, xy)
    world_T_mast = stand(rig, xy, heading, ground, slope)
    angles = panorama(rig, options, overlap=_OVERLAP, rows=lambda down: (-_BELOW_HORIZON * down,))
    joints = np.tile(angles, (options.stops, 1))
    pan_tilt, flex = flexed(rig, options, joints, rng_flex)
    start = telemetry(rig, options, world_T_mast, joints, rng_telemetry)
    traverse = make_traverse(
        claimed_rig(rig, options, angles, rng_rig),
        options,
        start.world_T_mast,
        start.pan_tilt_rad,
        None,
        seed,
        file="images/{image}.png",
    )
    truth = Truth(
        rig=rig,
        world_T_mast=world_T_mast,
        pan_tilt_rad=pan_tilt,
        landmarks_m=np.zeros((0, 3)),
        uv_px=np.zeros((0, 2)),
        outlier=np.zeros(0, dtype=bool),
        flex=flex,
    )
    return Rendering(
        traverse=traverse, truth=truth, telemetry_start=start, options=options, seed=seed, _scene=scene
    )
