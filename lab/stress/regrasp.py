"""Stress of what lies between grasps: one object grasped, let go, moved and turned about, hidden, and grasped again."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from finforce.transforms import move_pose, step_between
from finforce_ifea.errors import ContactError
from lab.presses import circle
from lab.stress.objects import Chain, HardScene, PressedImage, build_prism, press_scene, rectangle
from lab.stress.session import Bench, judge
from lab.stress.stress import Family, Plan, Trial, attempt

SECTIONS = {
    "rod": circle(0.0125),
    "thin rod": circle(0.006),
    "bar": rectangle(0.02, 0.02),
    "flat bar": rectangle(0.016, 0.03),
}
GRASPS = 3
HEIGHTS = (0.025, 0.060)  # [m], for the bench finger as all lengths here
DEPTHS = (0.001, 0.006)
AWAY = 0.03  # [m], standard deviation of the way between two grasps, in its middle
TUMBLE = 1.0  # [rad], of the turn there
TRAVEL = (15, 60)  # images that the way takes
HIDDEN = 0.3  # share of the ways on which no pose is seen, and of the grasps in which none is from the first load on
POSE_IMAGES = (1, 3, 10)  # images from one pose to the next
MOST_DRAWS = 20


def draw_grasps(bench: Bench, name: str, random: np.random.Generator) -> list[list[PressedImage]]:
    """Return the images of some grasps of one object, each approached, pressed, held and released."""
    mesh, grasps, draws = build_prism(SECTIONS[name]), [], 0
    while len(grasps) < GRASPS and draws < MOST_DRAWS:
        draws += 1
        scene = HardScene(
            name=name,
            mesh=mesh,
            height=random.uniform(*HEIGHTS),
            tilt=random.uniform(-np.pi, np.pi),
            depth=random.uniform(*DEPTHS),
        )
        try:
            images = press_scene(bench, scene)
        except ContactError:  # a corner on which the jaw finds no equilibrium
            continue
        grasps.append([*images, *images[::-2]])
    return grasps


def draw_way(start: PressedImage, end: PressedImage, random: np.random.Generator) -> list[PressedImage]:
    """Return the images of an object that is moved from one pose to another, out of the way and turned about."""
    step, middle = step_between(start.T, end.T), np.r_[random.normal(0.0, AWAY, 3), random.normal(0.0, TUMBLE, 3)]
    middle[0] = abs(middle[0])  # away from the jaw
    images = []
    for share in np.linspace(0.0, 1.0, int(random.integers(*TRAVEL))):
        share = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        T = move_pose(start.T, share * step)
        T[:3, :3] = Rotation.from_rotvec(np.sin(np.pi * share) * middle[3:]).as_matrix() @ T[:3, :3]
        T[:3, 3] += np.sin(np.pi * share) * middle[:3]
        images.append(PressedImage(T=T, points=end.points, force=end.force, torque=end.torque))
    return images


def run_regrasp(plan: Plan) -> Iterator[Trial]:
    """Yield the images of every grasp, not those between."""
    bench = Bench(plan)
    for seed in range(plan.share(12)):
        random = plan.random("regrasp", seed)
        name = str(random.choice(list(SECTIONS)))
        grasps = draw_grasps(bench, name, random)
        if grasps:
            yield from play_grasps(bench, name, grasps, seed, random)


def play_grasps(
    bench: Bench, name: str, grasps: list[list[PressedImage]], seed: int, random: np.random.Generator
) -> Iterator[Trial]:
    """Yield the images of the grasps of an object after the tare."""
    chain, period = Chain(bench, build_prism(SECTIONS[name]), random), int(random.choice(POSE_IMAGES))
    images = [(image, False, True) for image in grasps[0][:1] * bench.estimator.settings.tare_frames]
    for number, grasp in enumerate(grasps):
        if number:
            is_seen = random.random() >= HIDDEN
            images += [(image, False, is_seen) for image in draw_way(grasps[number - 1][-1], grasp[0], random)]
            images += [(grasp[0], False, True)] * POSE_IMAGES[-1]  # where it lies before it is grasped
        is_hidden = random.random() < HIDDEN
        loaded = np.cumsum([bool(image.force.any()) for image in grasp]) > 0
        images += [(image, True, not (is_hidden and pressed)) for image, pressed in zip(grasp, loaded, strict=True)]
    before = images[0][0].T
    for index, (image, is_counted, is_seen) in enumerate(images):
        step, T = chain.see(image), image.T if is_seen and index % period == 0 else None
        if is_counted:  # the jaw moves, and the object does elsewhere
            chain.follow(before, image.T)
        before = image.T
        level = f"{name}, a pose in {period}"
        trial = attempt(seed, lambda s=step, at=T: chain.solve(s, at), lambda got, s=step: judge(got, s), level=level)
        if is_counted:
            yield trial


FAMILIES = (
    Family(
        name="regrasp",
        what="an object moved, turned about, hidden and grasped again, poses rare",
        run=run_regrasp,
        least_sure=0.8,
        timed=False,
    ),
)
