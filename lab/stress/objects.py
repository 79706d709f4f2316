"""Stress of contact place and solver together: hard objects at given poses, approached, pressed in and held."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finforce.transforms import invert_pose
from finforce_contact.estimator import ContactEstimator
from finforce_contact.loop import ForceLoop
from finforce_contact.mesh.object_mesh import ObjectMesh
from finforce_contact.parameters import ContactSettings
from finforce_contact.section import cut_outline
from finforce_ifea.errors import ContactError
from finforce_ifea.observation import Solution
from lab.presses import PressState, RigidOutline, circle, press_jaw
from lab.stress.session import LIKELIHOOD, OFFSET, PERIOD, Bench, SessionStep, judge, noise_of
from lab.stress.stress import Family, Plan, Trial, attempt

APPROACH, RISE, HOLD = 10, 20, 20
CLEAR = 0.02
# Noise of the poses [m], white on each axis.
POSE_NOISE = 1e-4


@dataclass(frozen=True, kw_only=True, eq=False)
class PressedImage:
    """The truth in one image: pose T_jaw_object (4, 4), key points (K, 3) [m], force [N] and torque [N m] (3,)."""

    T: NDArray
    points: NDArray
    force: NDArray
    torque: NDArray


def plan_depths(depth: float) -> NDArray:
    """Return the depth of the object in each image (n,) [m], from well clear of the jaw on."""
    last = min(depth, 0.0)
    approach = np.linspace(-CLEAR + last, last, APPROACH)
    rise = np.linspace(0.0, depth, RISE + 1)[1:] if depth > 0.0 else np.full(RISE, last)
    return np.concatenate([approach, rise, np.full(HOLD, depth)])


def press_scene(bench: Bench, scene: HardScene) -> list[PressedImage]:
    """Return what is true in each image; an object that no outline describes leaves the jaw as it is.

    Raises:
        ContactError: The jaw has no equilibrium with the object.
    """
    c, s = np.cos(scene.tilt), np.sin(scene.tilt)
    R, jaw, surface = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]]), bench.jaw, bench.mechanics.contact.surface
    height = bench.find_height(scene.height)
    polygons = cut_outline(scene.mesh, R, float(surface.high[0]), 0.0)
    try:
        rigid = RigidOutline(polygons, float(surface.high[1]))
    except ContactError:
        rigid = None
    depths, presses = plan_depths(bench.find_depth(scene.depth)), {}
    if rigid is not None and not scene.is_impossible:
        rising = np.unique(depths[depths > 0.0])
        found = press_jaw(bench.mechanics.model, surface, jaw.inner_face_x, rigid, height, rising)
        presses = {press.depth: press for press in found}
    leading = min(polygon[:, 0].min() for polygon in polygons)
    frames = []
    for depth in depths.tolist():
        T = np.eye(4)
        T[:3, :3] = R
        flat = jaw.inner_face_x - leading - depth
        x = flat if rigid is None else rigid.find_origin(jaw.inner_face_x, depth, height)
        T[:3, 3] = x, 0.0, height
        frames.append(_frame_of(bench, T, presses.get(depth)))
    return frames


def _frame_of(bench: Bench, T: NDArray, press: PressState | None) -> PressedImage:
    """Return the truth at a pose, with the jaw at rest without a press."""
    if press is None:
        return PressedImage(T=T, points=bench.jaw.keypoints, force=np.zeros(3), torque=np.zeros(3))
    model = bench.mechanics.model
    points = model.positions(model.attach(bench.jaw.keypoints, 1.0), press.q)
    return PressedImage(T=T, points=points, force=press.force, torque=press.torque)


class Chain:
    """Contact estimator and solver of one jaw in their loop, and the camera that sees the jaw with noise."""

    def __init__(self, bench: Bench, mesh: ObjectMesh, random: np.random.Generator) -> None:
        """Start both anew."""
        self._random = random
        contact = ContactEstimator(bench.jaw, mesh=mesh, settings=ContactSettings(mesh=bench.plan.mesh))
        self._loop = ForceLoop(contact, bench.estimator)
        self._offsets = OFFSET * random.normal(size=bench.jaw.keypoints.shape)
        self._stamp = 10.0
        bench.estimator.forget()

    def see(self, frame: PressedImage) -> SessionStep:
        """Return the next image of what is true, with noise; the contact is not known yet."""
        self._stamp += PERIOD
        noise = noise_of(self._random, (len(frame.points),))
        return SessionStep(
            stamp=self._stamp,
            points=frame.points + self._offsets + noise,
            likelihood=np.full(len(frame.points), LIKELIHOOD),
            contact=None,
            force=frame.force,
            torque=frame.torque,
        )

    def follow(self, T_before: NDArray, T: NDArray) -> None:
        """Take the motion of the jaw, by which an object that rests has come from one pose (4, 4) to another."""
        self._loop.contact.estimator.carry(T @ invert_pose(T_before))

    def solve(self, step: SessionStep, T: NDArray | None) -> Solution:
        """Return what both make of an image and a pose T_jaw_object (4, 4), None where it was not seen."""
        if T is not None:
            T = T.copy()
            T[:3, 3] += POSE_NOISE * self._random.normal(size=3)
            self._loop.take_pose(step.stamp, T)
        return self._loop.update(step.observation)


def run_objects(plan: Plan) -> Iterator[Trial]:
    """Yield every scene, image by image."""
    bench = Bench(plan)
    for scene in build_scenes():
        frames = press_scene(bench, scene)
        for seed in range(plan.share(2)):
            yield from play_scene(bench, scene, frames, seed)


def play_scene(bench: Bench, scene: HardScene, frames: list[PressedImage], seed: int) -> Iterator[Trial]:
    """Yield the images of a scene after the tare, each a step of contact estimator and solver."""
    chain = Chain(bench, scene.mesh, bench.plan.random("objects", scene.name, seed))
    tare = [frames[0]] * bench.estimator.settings.tare_frames
    for index, frame in enumerate([*tare, *frames]):
        step = chain.see(frame)
        trial = attempt(
            seed,
            lambda s=step, f=frame: chain.solve(s, f.T),
            lambda got, s=step: judge(got, s),
            level=scene.name,
        )
        if index >= len(tare):
            yield trial


FAMILIES = (
    Family(
        name="objects", what="objects grazing, flat, sharp, tiny, huge, thin, open", run=run_objects, least_sure=0.5
    ),
)


LENGTH = 0.06


@dataclass(frozen=True, kw_only=True, eq=False)
class HardScene:
    """An object and where it presses.

    Attributes:
        name: of the scene.
        mesh: of the object.
        height: of its origin along the jaw [m].
        tilt: its turn from x to z [rad].
        depth: of the press below the undeformed surface [m]; negative: it stays away.
        is_impossible: True if no press is like this: the jaw stays at rest, whatever the poses say.
    """

    name: str
    mesh: ObjectMesh
    height: float = 0.04
    tilt: float = 0.0
    depth: float = 3e-3
    is_impossible: bool = False


def build_prism(section: NDArray, length: float = LENGTH) -> ObjectMesh:
    """Return the closed prism along y over a convex section (n, 2) of x and z [m], counterclockwise from x to z."""
    count = len(section)
    ring = np.stack([section[:, 0], np.full(count, -0.5 * length), section[:, 1]], axis=1)
    a, b = np.arange(count), (np.arange(count) + 1) % count
    sides = np.stack([a, a + count, b, b, a + count, b + count], axis=1).reshape(-1, 3)
    low = np.stack([a, b, np.full(count, 2 * count)], axis=1)
    high = np.stack([b, a, np.full(count, 2 * count + 1)], axis=1) + [count, count, 0]
    middle = section.mean(axis=0)
    ends = [[middle[0], y, middle[1]] for y in (-0.5 * length, 0.5 * length)]
    vertices = np.vstack([ring, ring + [0.0, length, 0.0], ends])
    triangles = np.concatenate([sides, low, high]).astype(np.int32)
    return ObjectMesh(vertices=vertices, triangles=triangles, watertight=True, name="prism")


def rectangle(size_x: float, size_z: float) -> NDArray:
    """Return a rectangular section (4, 2) [m]."""
    return 0.5 * np.array([[-size_x, -size_z], [size_x, -size_z], [size_x, size_z], [-size_x, size_z]])


def leave_open(mesh: ObjectMesh) -> ObjectMesh:
    """Return a mesh without some triangles of its ends."""
    kept = mesh.triangles[: int(0.9 * len(mesh.triangles))]
    return ObjectMesh(vertices=mesh.vertices, triangles=kept, watertight=False, name="open prism")


def build_scenes() -> tuple[HardScene, ...]:
    """Return the scenes."""
    rod, bar = build_prism(circle(0.0125)), build_prism(rectangle(0.03, 0.03))
    return (
        HardScene(name="rod", mesh=rod),
        HardScene(name="rod, single precision", mesh=replace(rod, vertices=rod.vertices.astype(np.float32))),
        HardScene(name="rod near the base", mesh=rod, height=0.018),
        HardScene(name="rod near the tip", mesh=rod, height=0.066),
        HardScene(name="rod grazing by 0.05 mm", mesh=rod, depth=5e-5),
        HardScene(name="rod grazing by 0.2 mm", mesh=rod, depth=2e-4),
        HardScene(name="rod 0.3 mm away", mesh=rod, depth=-3e-4),
        HardScene(name="rod far away", mesh=rod, depth=-3e-2),
        HardScene(name="coplanar face", mesh=bar, depth=2e-4),
        HardScene(name="coplanar face, deeper", mesh=bar, depth=3e-3),
        HardScene(name="wall along the jaw", mesh=build_prism(rectangle(0.03, 0.2)), depth=1e-4),
        HardScene(name="edge", mesh=bar, tilt=np.pi / 4),
        HardScene(name="edge of a leaning bar", mesh=bar, tilt=0.12),
        HardScene(name="bar over the tip", mesh=bar, height=0.085, depth=1e-3),
        HardScene(name="wire of 0.5 mm", mesh=build_prism(circle(0.25e-3)), depth=1e-3, is_impossible=True),
        HardScene(name="wire of 2 mm", mesh=build_prism(circle(1e-3)), depth=2e-3),
        HardScene(name="drum of 1 m", mesh=build_prism(circle(0.5)), depth=5e-4),
        HardScene(name="block of 1 m", mesh=build_prism(rectangle(1.0, 1.0)), depth=5e-5),
        HardScene(name="plate of 1 mm, edge on", mesh=build_prism(rectangle(0.03, 1e-3)), depth=2e-3),
        HardScene(
            name="plate of 0.3 mm, edge on", mesh=build_prism(rectangle(0.03, 3e-4)), depth=2e-3, is_impossible=True
        ),
        HardScene(name="plate of 1 mm, face on", mesh=build_prism(rectangle(1e-3, 0.03)), depth=2e-3),
        HardScene(
            name="plate of 0.3 mm, face on", mesh=build_prism(rectangle(3e-4, 0.03)), depth=2e-3, is_impossible=True
        ),
        HardScene(name="open rod", mesh=leave_open(rod)),
        HardScene(name="open bar", mesh=leave_open(bar), depth=2e-4),
        HardScene(name="engulfing", mesh=build_prism(rectangle(0.2, 0.2), 0.2), depth=0.11, is_impossible=True),
        HardScene(name="beyond the tip", mesh=rod, height=0.2, is_impossible=True),
    )
