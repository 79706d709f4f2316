"""Images of a gripper as its wrist camera takes them, with the bodies in them and the truth about its key points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, project
from finforce.gripper_frames import CAMERAS, jaw_in_camera
from finforce.transforms import invert_pose
from finforce_sim.gripper import TwinState
from finforce_sim.mechanics import Assembly
from finforce_sim.render import (
    Body,
    Decal,
    Lighting,
    Paint,
    Picture,
    RenderedScene,
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
_BOX = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]], dtype=float)
_BOX_TRIANGLES = np.array(
    [[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4], [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6]]
    + [[1, 3, 5], [3, 7, 5]]
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Wardrobe:
    """The materials of a gripper and its object, the same in all its images."""

    jaw: Paint
    holder: Paint
    palm: Paint
    thing: Paint
    dot_color: NDArray
    dot_radius: float

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Wardrobe:
        """Return materials by chance; the dot stands out from its holder."""
        holder = draw_paint(rng, ("plain", "noise"))
        holder = replace(holder, color=draw_color(rng, 0.02, 0.7), gloss=0.3)
        # a dot of the holder's brightness would be no mark
        seen = holder.color if holder.pattern == "plain" else np.maximum(holder.color, holder.second)
        bright = float(seen.mean()) < 0.2
        dot = draw_color(rng, 0.7, 0.95) ** 0.3 if bright else draw_color(rng, 0.01, 0.02)
        # a draw more than is used: with it the pictures of a seed stay what they were
        jaw, palm, thing, _ = draw_jaw_paint(rng), draw_paint(rng, ("plain", "noise")), draw_paint(rng), draw_paint(rng)
        radius = float(rng.uniform(*DOT_RADII))
        return cls(jaw=jaw, holder=holder, palm=palm, thing=thing, dot_color=dot, dot_radius=radius)


def build_box(bounds: NDArray, T: NDArray, paint: Paint, decals: tuple[Decal, ...] = ()) -> Body:
    """Return a box of bounds (2, 3) [m] in a frame at T (4, 4)."""
    rest = bounds[0] + _BOX * (bounds[1] - bounds[0])
    return Body(vertices=_move(rest, T), triangles=_BOX_TRIANGLES, rest=rest, paint=paint, decals=decals)


def _move(points: NDArray, T: NDArray) -> NDArray:
    return points @ T[:3, :3].T + T[:3, 3]


SHUTTER = 0.008  # [s] that the sensor collects light
BANDS = 16  # of rows that a rolling shutter exposes together


@dataclass(frozen=True, kw_only=True, eq=False)
class TrueJaw:
    """The truth about one jaw in one image.

    Attributes:
        T_camera_jaw: (4, 4).
        points: key points (K, 3) [m], jaw frame.
        pixels: (K, 2) column and row in the raw image [px].
        visible: (K,) bool, inside the image with nothing before them.
        force: (3,) [N] that the object applies to the jaw, jaw frame.
        torque: (3,) [N m] about the origin of the jaw frame.
    """

    T_camera_jaw: NDArray
    points: NDArray
    pixels: NDArray
    visible: NDArray
    force: NDArray
    torque: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Shot:
    """One image, developed or as it comes through the lens.

    Attributes:
        color: (h, w, 3) uint8 red, green, blue; linear light before it is developed.
        depth: (h, w) float32 [m] as the camera measures it, NaN where it does not; true before.
        jaws: the truth by side.
    """

    color: NDArray
    depth: NDArray
    jaws: Mapping[str, TrueJaw]


class SimulatedCamera:
    """Takes pictures of a gripper; materials, lights and background come from the seed and stay.

    Attributes:
        T_gripper_camera: (4, 4) of the scenario's camera.
        mesh: of the object in its own frame; None without one.

    Args:
        assembly: jaws and object, with the scenario's camera, light and rolling shutter.
        camera: intrinsics.
        seed: of everything that chance decides.
        depth_step: of the depth image [m]; the ROS driver of a D405 gives 1 mm, the camera itself 0.1 mm.
    """

    def __init__(self, assembly: Assembly, camera: CameraIntrinsics, seed: int, depth_step: float = 1e-3) -> None:
        rng = np.random.default_rng((seed, 7))
        self.camera, self.depth_step, self.mesh = camera, depth_step, assembly.object_mesh
        self.T_gripper_camera = CAMERAS[assembly.scenario.camera]
        self._assembly, self._readout, self._seed = assembly, assembly.scenario.readout, seed
        self._wardrobe = Wardrobe.draw(rng)
        self._look: Lighting = draw_look(rng, assembly.scenario.light)
        self._T_camera_gripper = invert_pose(self.T_gripper_camera)

    def shoot(self, state: TwinState, before: TwinState | None = None, view: Shot | None = None) -> Shot:
        """Return the image of a state, given that of the image before; the same seed and stamp give the same noise.

        A view of both that `look` gave before, perhaps at other forces, saves rendering it.
        """
        view = view or self.look(state, before)
        jaws = {side: replace(view.jaws[side], force=jaw.force, torque=jaw.torque) for side, jaw in state.jaws.items()}
        return self.develop(replace(view, jaws=jaws), state.stamp, self._smear(state, before))

    def look(self, state: TwinState, before: TwinState | None = None) -> Shot:
        """Return what a perfect sensor would see of a state; its upper rows are of a moment before."""
        stage = self._build_stage(state)
        jaws = {side: self._look_for(side, state, stage) for side in state.jaws}
        if before is not None and self._readout and before.stamp < state.stamp:
            jaws = {side: self._roll_truth(side, true, state, before) for side, true in jaws.items()}
            return Shot(**vars(self._roll(state, before)), jaws=jaws)
        return Shot(**vars(stage.render(self.camera)), jaws=jaws)

    def _shares(self, rows: NDArray, state: TwinState, before: TwinState) -> NDArray:
        """Return how far back, of the way to the state before, rows (n,) [px] are exposed."""
        left = 1.0 - rows / (self.camera.height - 1)
        return left.clip(0.0, 1.0) * self._readout / (state.stamp - before.stamp)

    def _roll(self, state: TwinState, before: TwinState) -> Picture:
        """Return the image of a rolling shutter, band by band."""
        edges = np.linspace(0, self.camera.height, BANDS + 1).round().astype(int)
        bands = []
        for share, low, high in zip(
            self._shares(0.5 * (edges[:-1] + edges[1:] - 1), state, before), edges[:-1], edges[1:], strict=True
        ):
            bands.append(self._build_stage(state.blend(before, share)).render(self.camera, slice(low, high)))
        return Picture(**{name: np.concatenate([getattr(band, name) for band in bands]) for name in ("color", "depth")})

    def _roll_truth(self, side: str, true: TrueJaw, state: TwinState, before: TwinState) -> TrueJaw:
        """Return the truth with the pixels at which points are when their own row is exposed."""
        now, then = self._points(side, state), self._points(side, before)
        pixels = true.pixels
        for _ in range(3):  # in another row it is another time, by which the point has moved by a part of that
            shares = self._shares(np.nan_to_num(pixels[:, 1]), state, before)
            pixels = project(now + shares[:, None] * (then - now), self.camera)
        return replace(true, pixels=pixels)

    def _points(self, side: str, state: TwinState) -> NDArray:
        """Return a jaw's key points (K, 3) [m], camera frame."""
        return _move(state.jaws[side].keypoints, self._place(side, state))

    def _place(self, side: str, state: TwinState) -> NDArray:
        """Return T_camera_jaw (4, 4)."""
        return jaw_in_camera(self.T_gripper_camera, side, state.jaws[side].origin_x)

    def develop(self, view: Shot, stamp: float, smear: NDArray | None = None) -> Shot:
        """Return a view as the sensor gives it.

        Args:
            view: through the lens.
            stamp: [s] that makes, with the seed, the noise.
            smear: (2,) standard deviations along the rows and columns by which motion blurs [px].
        """
        rng = np.random.default_rng((self._seed, 8, round(stamp * 1e6)))
        noise = replace(D405_NOISE, quantum=self.depth_step)
        color = expose(view.color, self._look.exposure, rng, smear)
        depth = measure_depth(view.depth, color, self.camera, rng, noise)
        return Shot(color=color, depth=depth, jaws=view.jaws)

    def _build_stage(self, state: TwinState) -> RenderedScene:
        T, mesh = self._T_camera_gripper, self.mesh
        bodies = [build_box(PALM, T, self._wardrobe.palm)]
        for side in state.jaws:
            bodies += self._dress_jaw(side, state)
        if mesh is not None and state.T_gripper_object is not None:
            vertices = _move(mesh.vertices, T @ state.T_gripper_object)
            paint = self._wardrobe.thing
            bodies.append(Body(vertices=vertices, triangles=mesh.triangles, rest=mesh.vertices, paint=paint))
        return RenderedScene(bodies, self._look, T[:3, :3], T[:3, 3])

    def _dress_jaw(self, side: str, state: TwinState) -> list[Body]:
        """Return a deformed jaw, and its holder with the reference dot."""
        wardrobe, T_camera_jaw, mesh = self._wardrobe, self._place(side, state), self._assembly.pressed[side].mesh
        centre, rest = self._assembly.jaws[side].reference_point, mesh.nodes
        dot = Decal(centre=centre, radius=wardrobe.dot_radius, color=wardrobe.dot_color)
        # a finger whose clamped part is in view carries the dot itself
        own = (dot,) if centre[2] > 0.0 else ()
        moved = _move(state.jaws[side].vertices, T_camera_jaw)
        jaw = Body(vertices=moved, triangles=mesh.surface, rest=rest, paint=wardrobe.jaw, decals=own)
        holder = HOLDER.copy()
        if own:
            # the holder is as wide as the finger that stands in it
            holder[:, :2] = np.stack((rest.min(axis=0)[:2], rest.max(axis=0)[:2]))
        return [jaw, build_box(holder, T_camera_jaw, wardrobe.holder, () if own else (dot,))]

    def _look_for(self, side: str, state: TwinState, stage: RenderedScene) -> TrueJaw:
        """Return where the key points of a jaw are and which of them can be seen."""
        jaw, camera = state.jaws[side], self.camera
        points = self._points(side, state)
        pixels = project(points, camera)
        size = np.array([camera.width, camera.height])
        inside = ((pixels >= 0.0) & (pixels <= size - 1.0)).all(axis=1)
        return TrueJaw(
            T_camera_jaw=self._place(side, state),
            points=jaw.keypoints,
            pixels=pixels,
            visible=inside & stage.sees(points),
            force=jaw.force,
            torque=jaw.torque,
        )

    def _smear(self, state: TwinState, before: TwinState | None) -> NDArray:
        """Return the standard deviations (2,) [px] of the way that the jaws go while the shutter is open."""
        if before is None or not 0.0 < state.stamp - before.stamp < 1.0:
            return np.zeros(2)
        moved = []
        for side in state.jaws:
            reference = self._assembly.jaws[side].reference_point
            now, then = (
                project(_move(np.vstack((one.jaws[side].keypoints, reference)), self._place(side, one)), self.camera)
                for one in (state, before)
            )
            moved.append(np.abs(now - then).mean(axis=0))
        return np.mean(moved, axis=0) * SHUTTER / (state.stamp - before.stamp) / np.sqrt(12.0)
