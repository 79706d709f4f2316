"""Images of a gripper as its wrist camera takes them, with the bodies in them and the truth about its key points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, project
from finforce.gripper_frames import jaw_in_camera
from finforce.transforms import invert_pose
from finforce_contact.mesh.object_mesh import ObjectMesh
from finforce_ifea.jaw.jaw import Jaw
from finforce_sim.gripper import TwinState
from finforce_sim.render import (
    Body,
    Decal,
    Lighting,
    Paint,
    Picture,
    RenderedScene,
    Window,
    draw_color,
    draw_jaw_paint,
    draw_look,
    draw_paint,
)
from finforce_sim.sensor import D405_NOISE, expose, measure_depth

# Boxes (low, high) [m]: the holder in the jaw frame, flush with the jaw's sides, and the palm in the gripper frame.
HOLDER = np.array([[-0.017, -0.010, -0.022], [0.017, 0.010, 0.0]])
PALM = np.array([[-0.080, -0.030, -0.070], [0.080, 0.022, -0.022]])
DOT_RADII = (1.5e-3, 2.3e-3)
OCCLUDER_CHANCE = 0.15
_BOX = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]], dtype=float)
_BOX_TRIANGLES = np.array(
    [[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4], [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6]]
    + [[1, 3, 5], [3, 7, 5]]
)


@dataclass(frozen=True, kw_only=True, eq=False)
class DrawnJaw:
    """A jaw as it is drawn: the jaw itself, its vertices (n, 3) [m] at rest and its triangles (m, 3)."""

    jaw: Jaw
    rest: NDArray
    triangles: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Wardrobe:
    """The materials of a gripper and its object, the same in all its images."""

    jaw: Paint
    holder: Paint
    palm: Paint
    thing: Paint
    occluder: Paint
    dot_color: NDArray
    dot_radius: float

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Wardrobe:
        """Return materials by chance; the dot stands out from its holder."""
        holder = draw_paint(rng, ("plain", "noise"))
        holder = replace(holder, color=draw_color(rng, 0.02, 0.7), gloss=0.3)
        # a dot of the holder's brightness would be no mark
        bright = float(np.maximum(holder.color, holder.second).mean()) < 0.2
        dot = draw_color(rng, 0.7, 0.95) ** 0.3 if bright else draw_color(rng, 0.01, 0.02)
        return cls(
            jaw=draw_jaw_paint(rng),
            holder=holder,
            palm=draw_paint(rng, ("plain", "noise")),
            thing=draw_paint(rng),
            occluder=draw_paint(rng),
            dot_color=dot,
            dot_radius=float(rng.uniform(*DOT_RADII)),
        )


def dress_jaw(shape: DrawnJaw, vertices: NDArray, T_camera_jaw: NDArray, wardrobe: Wardrobe) -> list[Body]:
    """Return a jaw with deformed vertices (n, 3) [m], jaw frame, and its holder with the reference dot."""
    dot = Decal(place=shape.jaw.reference_point, radius=wardrobe.dot_radius, color=wardrobe.dot_color)
    # a finger whose clamped part is in view carries the dot itself
    own = (dot,) if shape.jaw.reference_point[2] > 0.0 else ()
    moved = _move(vertices, T_camera_jaw)
    jaw = Body(vertices=moved, triangles=shape.triangles, rest=shape.rest, paint=wardrobe.jaw, decals=own)
    holder = HOLDER.copy()
    if own:
        # the holder is as wide as the finger that stands in it
        low, high = shape.rest.min(axis=0), shape.rest.max(axis=0)
        holder[:, :2] = np.stack((low[:2], high[:2]))
    return [jaw, build_box(holder, T_camera_jaw, wardrobe.holder, () if own else (dot,))]


def dress_palm(T_camera_gripper: NDArray, wardrobe: Wardrobe) -> Body:
    """Return the palm, behind the holders."""
    return build_box(PALM, T_camera_gripper, wardrobe.palm)


def dress_object(mesh: ObjectMesh, T_camera_object: NDArray, wardrobe: Wardrobe) -> Body:
    """Return the object."""
    return Body(
        vertices=_move(mesh.vertices, T_camera_object),
        triangles=mesh.triangles,
        rest=mesh.vertices,
        paint=wardrobe.thing,
    )


def draw_occluders(T_camera_gripper: NDArray, wardrobe: Wardrobe, rng: np.random.Generator) -> list[Body]:
    """Return, now and then, a bar somewhere between camera and jaws."""
    if rng.random() > OCCLUDER_CHANCE:
        return []
    size = rng.uniform((0.004, 0.004, 0.004), (0.05, 0.01, 0.05))
    low = rng.uniform((-0.06, 0.02, 0.0), (0.06, 0.04, 0.08))
    return [build_box(np.stack((low, low + size)), T_camera_gripper, wardrobe.occluder)]


def build_box(bounds: NDArray, T: NDArray, paint: Paint, decals: tuple[Decal, ...] = ()) -> Body:
    """Return a box of bounds (2, 3) [m] in a frame at T (4, 4)."""
    rest = bounds[0] + _BOX * (bounds[1] - bounds[0])
    return Body(vertices=_move(rest, T), triangles=_BOX_TRIANGLES, rest=rest, paint=paint, decals=decals)


def _move(points: NDArray, T: NDArray) -> NDArray:
    return points @ T[:3, :3].T + T[:3, 3]


SHUTTER = 0.008  # [s] that the sensor collects light
WINDOW_MARGIN = 90  # [px] around the jaws
BANDS = 16  # of rows that a rolling shutter exposes together


@dataclass(frozen=True, kw_only=True, eq=False)
class TrueKeypoints:
    """Where a jaw's key points are in an image.

    Attributes:
        T_camera_jaw: (4, 4).
        points: (K + 1, 3) [m] jaw frame, the key points and then the reference point.
        pixels: (K + 1, 2) column and row [px].
        visible: (K + 1,) bool, inside the image with nothing before them.
    """

    T_camera_jaw: NDArray
    points: NDArray
    pixels: NDArray
    visible: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Shot:
    """One image.

    Attributes:
        color: (h, w, 3) uint8 red, green, blue.
        depth: (h, w) float32 [m] as the camera measures it, NaN where it does not.
        truth: by side.
    """

    color: NDArray
    depth: NDArray
    truth: Mapping[str, TrueKeypoints]


@dataclass(frozen=True, kw_only=True, eq=False)
class WristView:
    """What comes through the lens: light and true depth, and the truth by side."""

    picture: Picture
    truth: Mapping[str, TrueKeypoints]


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneSetting:
    """What stands before the camera, and how it is lit.

    Attributes:
        shapes: of the jaws, by side.
        mesh: of the object, None without one.
        camera: intrinsics.
        T_gripper_camera: (4, 4).
        light: "bright", "dim" or "any".
        clutter: whether bars may stand before the jaws.
        depth_step: of the depth image [m]; the ROS driver of a D405 gives 1 mm, the camera itself 0.1 mm.
        readout: from the exposure of the first row to that of the last one, at a state's stamp [s].
    """

    shapes: Mapping[str, DrawnJaw]
    mesh: ObjectMesh | None
    camera: CameraIntrinsics
    T_gripper_camera: NDArray
    light: str = "bright"
    clutter: bool = False
    depth_step: float = 1e-3
    readout: float = 0.0


class Photographer:
    """Takes pictures of a gripper; materials, lights and background come from the seed and stay.

    Args:
        setting: what is photographed.
        seed: of everything that chance decides.
        window_only: render no more of an image than the jaws with a margin; the rest stays black.
    """

    def __init__(self, setting: SceneSetting, seed: int, *, window_only: bool = False) -> None:
        rng = np.random.default_rng((seed, 7))
        self.setting = setting
        self._wardrobe = Wardrobe.draw(rng)
        self._look: Lighting = draw_look(rng, setting.light)
        self._T_camera_gripper = invert_pose(setting.T_gripper_camera)
        self._clutter = draw_occluders(self._T_camera_gripper, self._wardrobe, rng) if setting.clutter else []
        self._seed, self._window_only = seed, window_only
        self._last: tuple[float, Mapping[str, TrueKeypoints]] | None = None
        self._before: TwinState | None = None

    def shoot(self, state: TwinState) -> Shot:
        """Return the image of a state; the same seed and stamp give the same noise."""
        view = self.look(state)
        return self.develop(view, state.stamp, self._smear(state.stamp, view.truth))

    def look(self, state: TwinState) -> WristView:
        """Return what a perfect sensor would see of a state; its upper rows are of a moment before."""
        before, self._before = self._before, state
        stage = self._build_stage(state)
        truth = {side: self._look_for(side, state, stage) for side in state.jaws}
        if before is not None and self.setting.readout and before.stamp < state.stamp:
            picture = self._roll(state, before)
            truth = {side: self._roll_truth(side, true, state, before) for side, true in truth.items()}
            return WristView(picture=picture, truth=truth)
        window = self._window(truth) if self._window_only else None
        return WristView(picture=stage.render(self.setting.camera, window), truth=truth)

    def _shares(self, rows: NDArray, state: TwinState, before: TwinState) -> NDArray:
        """Return how far back, of the way to the state before, rows (n,) [px] are exposed."""
        left = 1.0 - rows / (self.setting.camera.height - 1)
        return left.clip(0.0, 1.0) * self.setting.readout / (state.stamp - before.stamp)

    def _roll(self, state: TwinState, before: TwinState) -> Picture:
        """Return the image of a rolling shutter, band by band."""
        edges = np.linspace(0, self.setting.camera.height, BANDS + 1).round().astype(int)
        bands = []
        for share, low, high in zip(
            self._shares(0.5 * (edges[:-1] + edges[1:] - 1), state, before), edges[:-1], edges[1:], strict=True
        ):
            window = Window(rows=slice(low, high), columns=slice(0, self.setting.camera.width))
            stage = self._build_stage(state.blend(before, share))
            bands.append((window.rows, stage.render(self.setting.camera, window)))
        layers = {
            name: np.concatenate([getattr(picture, name)[rows] for rows, picture in bands])
            for name in ("color", "depth", "owner")
        }
        return Picture(**layers)

    def _roll_truth(self, side: str, true: TrueKeypoints, state: TwinState, before: TwinState) -> TrueKeypoints:
        """Return the truth with the pixels at which points are when their own row is exposed."""
        now, then = self._points(side, state), self._points(side, before)
        pixels = true.pixels
        for _ in range(3):  # in another row it is another time, by which the point has moved by a part of that
            shares = self._shares(np.nan_to_num(pixels[:, 1]), state, before)
            pixels = project(now + shares[:, None] * (then - now), self.setting.camera)
        return replace(true, pixels=pixels)

    def _points(self, side: str, state: TwinState) -> NDArray:
        """Return a jaw's key points and then its reference point (K + 1, 3) [m], camera frame."""
        jaw = state.jaws[side]
        T = jaw_in_camera(self.setting.T_gripper_camera, side, jaw.origin_x)
        return np.vstack((jaw.keypoints, jaw.reference)) @ T[:3, :3].T + T[:3, 3]

    def develop(self, view: WristView, stamp: float, smear: NDArray | None = None) -> Shot:
        """Return a view as the sensor gives it.

        Args:
            view: through the lens.
            stamp: [s] that makes, with the seed, the noise.
            smear: (2,) standard deviations along the rows and columns by which motion blurs [px].
        """
        rng = np.random.default_rng((self._seed, 8, round(stamp * 1e6)))
        noise = replace(D405_NOISE, quantum=self.setting.depth_step)
        color = expose(view.picture.color, self._look.exposure, rng, smear)
        depth = measure_depth(view.picture.depth, color, self.setting.camera, rng, noise)
        return Shot(color=color, depth=depth, truth=view.truth)

    def _build_stage(self, state: TwinState) -> RenderedScene:
        T, bodies = self._T_camera_gripper, [dress_palm(self._T_camera_gripper, self._wardrobe), *self._clutter]
        for side, jaw in state.jaws.items():
            pose = jaw_in_camera(self.setting.T_gripper_camera, side, jaw.origin_x)
            bodies += dress_jaw(self.setting.shapes[side], jaw.vertices, pose, self._wardrobe)
        if self.setting.mesh is not None and state.T_gripper_object is not None:
            bodies.append(dress_object(self.setting.mesh, T @ state.T_gripper_object, self._wardrobe))
        return RenderedScene(bodies, self._look, T[:3, :3], T[:3, 3])

    def _look_for(self, side: str, state: TwinState, stage: RenderedScene) -> TrueKeypoints:
        """Return where the key points of a jaw are and which of them can be seen."""
        jaw, camera = state.jaws[side], self.setting.camera
        T = jaw_in_camera(self.setting.T_gripper_camera, side, jaw.origin_x)
        points, seen = np.vstack((jaw.keypoints, jaw.reference)), self._points(side, state)
        pixels = project(seen, camera)
        size = np.array([camera.width, camera.height])
        inside = ((pixels >= 0.0) & (pixels <= size - 1.0)).all(axis=1)
        return TrueKeypoints(T_camera_jaw=T, points=points, pixels=pixels, visible=inside & stage.sees(seen))

    def _window(self, truth: Mapping[str, TrueKeypoints]) -> Window:
        """Return the part of the image that holds the jaws."""
        pixels = np.vstack([found.pixels for found in truth.values()])
        size = np.array([self.setting.camera.width, self.setting.camera.height])
        low = np.clip(pixels.min(axis=0) - WINDOW_MARGIN, 0, size).astype(int)
        high = np.clip(pixels.max(axis=0) + WINDOW_MARGIN, 0, size).astype(int)
        return Window(rows=slice(low[1], high[1]), columns=slice(low[0], high[0]))

    def _smear(self, stamp: float, truth: Mapping[str, TrueKeypoints]) -> NDArray:
        """Return the standard deviations (2,) [px] of the way that key points go while the shutter is open."""
        before, self._last = self._last, (stamp, truth)
        if before is None or not 0.0 < stamp - before[0] < 1.0:
            return np.zeros(2)
        moved = [np.abs(found.pixels - before[1][side].pixels).mean(axis=0) for side, found in truth.items()]
        return np.mean(moved, axis=0) * SHUTTER / (stamp - before[0]) / np.sqrt(12.0)
