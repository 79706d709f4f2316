"""Stress of contact place and solver together: hard objects at given poses, approached, pressed in and held."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finforce_contact.estimator import ContactEstimator
from finforce_contact.localization.section import cut_outline
from finforce_contact.settings import ContactSettings
from finforce_eval.stress.contact_objects import HardScene, build_scenes
from finforce_eval.stress.press import Bench
from finforce_eval.stress.session import LIKELIHOOD, OFFSET, PERIOD, SessionStep, judge, noise_of, update
from finforce_eval.stress.stress import Family, Plan, Trial, attempt
from finforce_ifea.contact_mechanics.forward_press import PressState, press_jaw
from finforce_ifea.contact_mechanics.indenter import OutlineIndenter
from finforce_ifea.contact_mechanics.penalty import PenaltyContact
from finforce_ifea.errors import ContactError
from finforce_ifea.observation import Solution

APPROACH, RISE, HOLD = 10, 20, 20
CLEAR = 0.02
# Noise of the poses [m], white on each axis.
POSE_NOISE = 1e-4


class PressedOutline:
    """A rigid outline for the forward problem; depth counts from first touch with the undeformed jaw."""

    def __init__(self, polygons: tuple[NDArray, ...], length: float) -> None:
        """Builds the field of polygons (n, 2) [m] for a jaw of some length [m]; raises ContactError if too small."""
        self._indenter, self._length = OutlineIndenter(polygons), length

    def find_origin(self, face_x: float, depth: float, height: float) -> float:
        """Returns x [m] of the outline's origin at a depth and height [m]."""
        return face_x + self._indenter.field.front - float(self._place(depth, height)[0])

    def press(self, points: NDArray, stiffness: NDArray, face_x: float, depth: float, height: float) -> PenaltyContact:
        """See `finforce_ifea.contact_mechanics.forward_press.RigidObject`."""
        return self._indenter.press(points, stiffness, face_x, self._place(depth, height))

    def _place(self, depth: float, height: float) -> NDArray:
        place = np.array([0.0, 0.0, height])
        place[0] = depth + self._indenter.find_touch(place, 0.0, self._length)
        return place


@dataclass(frozen=True, kw_only=True, eq=False)
class PressedImage:
    """What is true in one image: pose T_jaw_object (4, 4), key points (K, 3) [m], force [N] and torque [N m] (3,)."""

    T: NDArray
    points: NDArray
    force: NDArray
    torque: NDArray


def plan_depths(scene: HardScene) -> NDArray:
    """Returns the depth of the object in each image (n,) [m], from well clear of the jaw on."""
    last = min(scene.depth, 0.0)
    approach = np.linspace(-CLEAR + last, last, APPROACH)
    rise = np.linspace(0.0, scene.depth, RISE + 1)[1:] if scene.depth > 0.0 else np.full(RISE, last)
    return np.concatenate([approach, rise, np.full(HOLD, scene.depth)])


def press_scene(bench: Bench, scene: HardScene) -> list[PressedImage]:
    """Returns what is true in each image; an object that no outline describes leaves the jaw as it is.

    Raises:
        ContactError: The jaw has no equilibrium with the object.
    """
    R, jaw, surface = rotation_of(scene.tilt), bench.jaw, bench.mechanics.contact.surface
    polygons = cut_outline(scene.mesh, R, float(surface.high[0]), scene.across)
    try:
        rigid = PressedOutline(polygons, float(surface.high[1]))
    except ContactError:
        rigid = None
    depths, presses = plan_depths(scene), {}
    if rigid is not None and not scene.is_impossible:
        rising = np.unique(depths[depths > 0.0])
        found = press_jaw(bench.mechanics.model, surface, jaw.inner_face_x, rigid, scene.height, rising)
        presses = {press.depth: press for press in found}
    leading = min(polygon[:, 0].min() for polygon in polygons)
    frames = []
    for depth in depths.tolist():
        T = np.eye(4)
        T[:3, :3] = R
        flat = jaw.inner_face_x - leading - depth
        x = flat if rigid is None else rigid.find_origin(jaw.inner_face_x, depth, scene.height)
        T[:3, 3] = x, scene.across, scene.height
        frames.append(_frame_of(bench, T, presses.get(depth)))
    return frames


def _frame_of(bench: Bench, T: NDArray, press: PressState | None) -> PressedImage:
    """Returns the truth at a pose, with the jaw at rest without a press."""
    if press is None:
        return PressedImage(T=T, points=bench.jaw.keypoints, force=np.zeros(3), torque=np.zeros(3))
    model = bench.mechanics.model
    points = model.positions(model.attach(bench.jaw.keypoints, 1.0), press.q)
    return PressedImage(T=T, points=points, force=press.force, torque=press.torque)


def rotation_of(tilt: float) -> NDArray:
    """Returns the turn (3, 3) by a tilt [rad] from x to z."""
    c, s = np.cos(tilt), np.sin(tilt)
    return np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])


class Chain:
    """Contact estimator and solver of one jaw, fed as their nodes are."""

    def __init__(self, bench: Bench, scene: HardScene, random: np.random.Generator) -> None:
        """Starts both anew and lets the solver tare while the object is clear."""
        self._bench, self._random = bench, random
        self._contact = ContactEstimator(bench.jaw, mesh=scene.mesh, settings=ContactSettings(mesh=bench.plan.mesh))
        self._offsets = OFFSET * random.normal(size=bench.jaw.keypoints.shape)
        self._stamp, self._last = 10.0, None
        bench.estimator.reset()

    def see(self, frame: PressedImage) -> SessionStep:
        """Returns the next image of what is true, with noise; the contact is not known yet."""
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

    def solve(self, step: SessionStep, T: NDArray) -> Solution:
        """Returns what both make of an image and a pose T_jaw_object (4, 4)."""
        T = T.copy()
        T[:3, 3] += POSE_NOISE * self._random.normal(size=3)
        self._contact.take_pose(step.stamp, T)
        last = self._last
        wrench = (last.force, last.torque) if last is not None and last.trusted else None
        surface = None if last is None else self._bench.estimator.surface()
        estimate = self._contact.update(step.stamp, surface, wrench)
        self._last = None
        self._last = update(self._bench, replace(step, contact=estimate.contact))
        return self._last


def run_objects(plan: Plan) -> Iterator[Trial]:
    """Yields every scene, image by image."""
    bench = Bench(plan)
    for scene in build_scenes():
        frames = press_scene(bench, scene)
        for seed in range(plan.share(2)):
            yield from play_scene(bench, scene, frames, seed)


def play_scene(bench: Bench, scene: HardScene, frames: list[PressedImage], seed: int) -> Iterator[Trial]:
    """Yields the images of a scene after the tare, each a step of contact estimator and solver."""
    chain = Chain(bench, scene, bench.plan.random("objects", scene.name, seed))
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
