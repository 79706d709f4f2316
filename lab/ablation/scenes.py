"""Short recordings that reach the estimator's rules: presses by the finger's full mechanics, with noise of a camera.

Friction is Coulomb's at every point of the surface, followed in steps of 0.1 mm, see `contact_mechanics.friction`; the
estimator knows it as one traction ratio that its own path predicts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import interp1d

from finforce.messages import SharedStddev
from finforce_ifea.contact_mechanics.friction import FRICTIONLESS, Traction, constant_traction
from finforce_ifea.contact_mechanics.indenter import Indenter, OutlineIndenter, RoundIndenter
from finforce_ifea.contact_mechanics.pressed_jaw import RigidContact
from finforce_ifea.filter.lateral_load import measure_torsion
from finforce_ifea.jaw.jaw import KEYPOINT_DISTANCE
from finforce_ifea.observation import Contact, Observation
from finforce_ifea.posture import WristPosture
from finforce_ifea.relaxation import RelaxationTerm
from lab.presses import circle, keep_shear
from lab.stress.objects import rectangle
from lab.stress.session import FRICTIONLESS as SMOOTH
from lab.stress.session import LIKELIHOOD, OFFSET, PERIOD, POSE, Bench, noise_of, tell_pose
from lab.stress.stress import Plan

# Steps of a press, of depth and height [m]; the last Newton step, as a share of the model's reach, and their number.
_STEP, _SETTLED, _ITERATIONS = 0.1e-3, 1e-5, 100
# Images of the tare and of rest before a press; speed of the press [m/s].
_TARE, _REST, _SPEED = 45, 15, 2e-3
_RADIUS, _HEIGHT = 12.5e-3, 0.040
_RELAXING = (RelaxationTerm(share=0.5, time_constant=5.0),)
_HELD = {"held": "either"}
_LIFTED = 100  # images after a lift
_ALIKE_LENGTH = 30e-3  # [m], over which a detector's noise is alike


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """A recording as the estimator sees it, and the truth.

    Attributes:
        images: n, those of the tare first.
        contacts: told with each image.
        forces: true (n, 3) [N].
        settings: of the estimator.
        relaxation: of the finger.
    """

    images: Sequence[Observation]
    contacts: Sequence[Contact]
    forces: NDArray
    settings: Mapping[str, Any]
    relaxation: tuple[RelaxationTerm, ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Press:
    """A press without noise: one row for each image.

    Attributes:
        states: of the contact: depth below first touch [m], shape, height [m] (n, 3).
        points: key points (n, K, 3) [m].
        forces: on the jaw (n, 3) [N].
        carried: motion along the finger of the surface that touches (n,) [m].
        indenter: the object.
    """

    states: NDArray
    points: NDArray
    forces: NDArray
    carried: NDArray
    indenter: Indenter = field(default_factory=RoundIndenter)


def ramp(*levels: float, speed: float = _SPEED, hold: int = 30) -> NDArray:
    """Return depths (n,) [m]: rest, then one level [mm] after the other at a speed [m/s], each held for some images."""
    parts = [np.zeros(_TARE + _REST)]
    for level in levels:
        last = parts[-1][-1]
        count = max(round(abs(1e-3 * level - last) / speed / PERIOD), 1)
        parts += [np.linspace(last, 1e-3 * level, count + 1)[1:], np.full(hold, 1e-3 * level)]
    return np.concatenate(parts)


def press(
    bench: Bench,
    depths: NDArray,
    *,
    indenter: Indenter | None = None,
    shape: float = _RADIUS,
    height: float | NDArray = _HEIGHT,
    friction: float = 0.0,
    along: NDArray | None = None,
) -> Press:
    """Press an object into the finger.

    Args:
        bench: whose full mechanics is pressed.
        depths: below first touch (n,) [m].
        indenter: the object; None for a cylinder.
        shape: its radius [m], or its tilt [rad].
        height: of it (n,) [m].
        friction: coefficient.
        along: force along the finger (n,) [N] that the object bears, without regard to friction; None where it slides.
    """
    indenter, contact = indenter or RoundIndenter(), bench.mechanics.contact
    contact.set_indenter(indenter)
    states = np.stack([depths, np.full(len(depths), shape), np.broadcast_to(height, depths.shape)], axis=1)
    probe, rest = contact.model.attach(bench.jaw.keypoints, KEYPOINT_DISTANCE), np.zeros(contact.model.size)
    q, before, traction, found, carried = rest, states[0], FRICTIONLESS, [], 0.0
    for i, state in enumerate(states):
        count = max(1, int(np.ceil(np.abs(state - before)[[0, 2]].max() / _STEP - 1e-9)))
        for x in np.linspace(before, state, count + 1)[1:] if found else [state]:
            at = x + [contact.find_touch(x), 0.0, 0.0]
            moved, before = np.array([before[0] - x[0], x[2] - before[2]]), x
            if x[0] <= 0.0:
                q, force, traction = rest, np.zeros(3), FRICTIONLESS
                continue
            traction, last = traction._replace(moved=moved), contact.place_points(q)
            q, force, traction = settle(contact, q, at, traction, None if along is None else float(along[i]))
            points = contact.place_points(q)
            pressure = np.linalg.norm(contact.press(points, at, traction).forces, axis=1)
            carried += float(pressure @ (points - last)[:, 2] / pressure.sum())
            if along is None and friction > 0.0:
                traction = keep_shear(contact, q, at, traction, friction)
        found.append((contact.model.positions(probe, q), force, carried))
    points, forces, motions = (np.stack(each) for each in zip(*found, strict=True))
    return Press(states=states, points=points, forces=forces, carried=motions, indenter=indenter)


class Settled(NamedTuple):
    """Unknowns of a jaw in equilibrium (size,), force on it (3,) [N], and traction."""

    q: NDArray
    force: NDArray
    traction: Traction


def settle(
    contact: RigidContact,
    q: NDArray,
    x: NDArray,
    traction: Traction,
    along: float | None = None,
    *,
    tolerance: float = _SETTLED,
) -> Settled:
    """Return the equilibrium of a jaw with an object in a state (3,)."""
    for _ in range(_ITERATIONS):
        pressed = contact.linearize(q, x, traction)
        if not pressed.touches:
            q = q + contact.approach(q, pressed.correction, x)
            continue
        q = q + pressed.correction
        change = 0.0 if along is None else (along - pressed.force[2]) / pressed.force_modes[2, 3]
        if along is not None:
            traction = constant_traction(traction.ratio + min(max(change, -0.2), 0.2))
        if pressed.size < tolerance and abs(change) < tolerance:
            break
    return Settled(q, pressed.force, traction)


def tell_height(bench: Bench, pressed: Press, error: float = 0.0) -> list[Contact]:
    """Return the height of first touch, off by an error [m], for each image."""
    return [Contact.fixed(bench.jaw, float(pressed.states[-1, 2]) + error)] * len(pressed.states)


def tell_outline(bench: Bench, pressed: Press, random: np.random.Generator, polygon: NDArray) -> list[Contact]:
    """Return the outline at a pose that is off by chance, constant over the recording, in every third image anew."""
    told, off = [], POSE * random.normal(size=3)
    profile, front = bench.mechanics.contact.profile, pressed.indenter.pressed.front
    for i, (depth, tilt, height) in enumerate(pressed.states):
        if i % 3:
            told.append(told[-1])
            continue
        touch = pressed.indenter.find_touch(np.array([0.0, tilt, height]), profile)
        told.append(tell_pose(bench, polygon, front, np.array([depth + touch, tilt, height]), off))
    return told


def film(
    bench: Bench,
    pressed: Press,
    contacts: Sequence[Contact],
    random: np.random.Generator,
    scale: float | NDArray = 1.0,
    **settings: Any,
) -> Scene:
    """Return the scene of a press with `scale` times a camera's noise, and its settings; friction 0 is stated."""
    count = pressed.points.shape[:2]
    noise = np.reshape(scale, (-1, 1, 1)) * noise_of(random, count)
    seen = pressed.points + OFFSET * random.normal(size=(1, count[1], 3)) + noise
    images = [
        Observation(stamp=10.0 + PERIOD * i, points=seen[i], likelihood=np.full(count[1], LIKELIHOOD))
        for i in range(count[0])
    ]
    return Scene(images=images, contacts=contacts, forces=pressed.forces, settings={**SMOOTH, **settings})


def turn_points(points: NDArray) -> NDArray:
    """Return how points (K, 3) [m] move by a turn about y (K, 3) [m/rad]."""
    return np.stack([points[:, 2], 0.0 * points[:, 2], -points[:, 0]], axis=1)


def shift(scene: Scene, motions: NDArray, **more: Any) -> Scene:
    """Return a scene whose key points are moved by (n, K or 1, 3) [m], with more told in each image."""
    images = [replace(each, points=each.points + by, **more) for each, by in zip(scene.images, motions, strict=True)]
    return replace(scene, images=images)


def see_bump(scene: Scene, start: int, way: NDArray, turn: float) -> Scene:
    """Return a scene whose camera is shifted (3,) [m] and turned about y [rad] from an image on."""
    motions = np.zeros((len(scene.images), len(scene.images[0].points), 3))
    rest = scene.images[0].points
    motions[start:] = way + turn * turn_points(rest)
    return shift(scene, motions)


BOX, WIDE = rectangle(0.024, 0.024), rectangle(0.050, 0.050)


def build_press(bench: Bench, random: np.random.Generator) -> Scene:
    """Press a cylinder in two steps, and half back."""
    pressed = press(bench, ramp(3, 5, 2.5))
    return film(bench, pressed, tell_height(bench, pressed, 0.3e-3), random)


def build_fast(bench: Bench, random: np.random.Generator) -> Scene:
    """Press at 60 mm/s, from one depth to another three times."""
    pressed = press(bench, ramp(5, 1, 6, 0.5, speed=0.06, hold=20))
    return film(bench, pressed, tell_height(bench, pressed, 0.3e-3), random)


def build_gross(bench: Bench, random: np.random.Generator) -> Scene:
    """Throw one key point in eight by millimetres, others in each image."""
    scene = build_press(bench, random)
    count = len(scene.images), len(scene.images[0].points)
    thrown = (random.random(count) < 0.125) & (np.arange(count[0])[:, None] >= _TARE)
    return shift(scene, thrown[..., None] * random.uniform(-10e-3, 10e-3, (*count, 3)))


def build_tailed(bench: Bench, random: np.random.Generator) -> Scene:
    """Let one key point in five be off by 1.2 mm, others in each image: far for chance, near for an error."""
    scene = build_press(bench, random)
    count = len(scene.images), len(scene.images[0].points)
    off = (random.random(count) < 0.2) & (np.arange(count[0])[:, None] >= _TARE)
    ways = random.normal(size=(*count, 3)) * [1.0, 0.0, 1.0]
    return shift(scene, 1.2e-3 * off[..., None] * ways / np.linalg.norm(ways, axis=2, keepdims=True))


def build_tapping(bench: Bench, random: np.random.Generator) -> Scene:
    """Tap eight times, 1.5 mm deep, at 30 mm/s."""
    pressed = press(bench, ramp(*8 * (1.5, 0.0), speed=0.03, hold=8))
    return film(bench, pressed, tell_height(bench, pressed, 0.3e-3), random)


def build_cluster(bench: Bench, random: np.random.Generator) -> Scene:
    """Shift a third of the key points together by 3 mm while the object is held."""
    scene = build_press(bench, random)
    motions = np.zeros((len(scene.images), len(scene.images[0].points), 3))
    motions[_TARE + _REST + 60 :, random.permutation(motions.shape[1])[:5]] = [3e-3, 0.0, 1e-3]
    return shift(scene, motions)


def build_noisy(bench: Bench, random: np.random.Generator) -> Scene:
    """See three times as much noise as in the tare."""
    pressed = press(bench, ramp(3, 5, 2.5))
    scale = np.where(np.arange(len(pressed.states)) < _TARE + _REST, 1.0, 3.0)
    return film(bench, pressed, tell_height(bench, pressed), random, scale)


def build_bumped(bench: Bench, random: np.random.Generator) -> Scene:
    """Bump the camera by 0.8 mm and a third of a degree under load."""
    return see_bump(build_press(bench, random), _TARE + _REST + 60, np.array([0.6e-3, 0.0, 0.5e-3]), 6e-3)


def build_rested(bench: Bench, random: np.random.Generator) -> Scene:
    """Hold a cylinder still for ten seconds."""
    pressed = press(bench, ramp(4, hold=300), height=0.025)
    return film(bench, pressed, tell_height(bench, pressed, 0.3e-3), random)


def build_nudged(bench: Bench, random: np.random.Generator) -> Scene:
    """Bump the camera by 0.2 mm under load."""
    return see_bump(build_press(bench, random), _TARE + _REST + 60, np.array([0.15e-3, 0.0, 0.13e-3]), 1.5e-3)


def build_drifting(bench: Bench, random: np.random.Generator) -> Scene:
    """Let the camera drift by 0.1 mm and 1 mrad in ten seconds."""
    pressed = press(bench, ramp(3, 5, 2.5, hold=90))
    scene = film(bench, pressed, tell_height(bench, pressed, 0.3e-3), random)
    share = np.linspace(-0.2, 1.0, len(scene.images)).clip(0.0)[:, None, None]
    rest = scene.images[0].points
    turn = 1e-3 * turn_points(rest)
    return shift(scene, share * (np.array([0.07e-3, 0.0, 0.07e-3]) + turn))


def build_unplaced(bench: Bench, random: np.random.Generator) -> Scene:
    """See the whole jaw off by a millimetre, two degrees and two percent, in another way each second, as is stated."""
    scene, rest = build_press(bench, random), bench.jaw.keypoints
    time = np.arange(len(scene.images))[:, None, None] * PERIOD
    phase = np.cumsum(np.where(time < _TARE * PERIOD, 0.0, 1.0), axis=0) * PERIOD
    way, turn, stretch = (np.sin(rate * phase) for rate in (3.0, 4.0, 5.0))
    turned = 0.035 * turn * turn_points(rest)
    longer = 0.02 * stretch * rest * [0.0, 0.0, 1.0]
    return shift(scene, 1e-3 * way * [0.7, 0.0, 0.7] + turned + longer, shared=SharedStddev(shift=0.7e-3))


def build_misplaced(bench: Bench, random: np.random.Generator) -> Scene:
    """State the contact 15 mm too high."""
    pressed = press(bench, ramp(3, 5, 2.5), height=0.030)
    return film(bench, pressed, tell_height(bench, pressed, 15e-3), random)


def build_slammed(bench: Bench, random: np.random.Generator) -> Scene:
    """State the contact 15 mm too high, and press at 60 mm/s."""
    pressed = press(bench, ramp(4, speed=0.06, hold=60), height=0.030)
    return film(bench, pressed, tell_height(bench, pressed, 15e-3), random)


def build_offset(bench: Bench, random: np.random.Generator) -> Scene:
    """State the contact 2.5 mm too low."""
    pressed = press(bench, ramp(3, 5, 2.5, hold=45))
    return film(bench, pressed, tell_height(bench, pressed, -2.5e-3), random)


def build_other_finger(bench: Bench, random: np.random.Generator) -> Scene:
    """Press a finger low down whose key points move by 1 % more or less each, and by 10 micrometres otherwise."""
    pressed = press(bench, ramp(3, 6, 3, hold=60), height=0.025)
    rest, moved = pressed.points[:1], pressed.points - pressed.points[:1]
    size = np.linalg.norm(moved, axis=2, keepdims=True)
    stretch = 0.01 * random.normal(size=(1, rest.shape[1], 1))
    other = 0.004 * size * np.sin(pressed.states[:, :1, None] / 3e-3 + 6.3 * random.random((1, rest.shape[1], 3)))
    bent = replace(pressed, points=rest + moved * (1.0 + stretch) + other)
    return film(bench, bent, tell_height(bench, pressed, 0.3e-3), random)


def build_sight(bench: Bench, random: np.random.Generator) -> Scene:
    """Rub an object, seen by a detector with lasting errors: half of the stated 0.3 mm, a third of that in common."""
    pressed = press(bench, ramp(4, 3, 5, hold=20), friction=0.4)
    told = tell_height(bench, pressed, 0.3e-3)
    scene = film(bench, pressed, told, random, 0.3, friction=0.45, friction_stddev=0.25)
    depths, shape = np.arange(-0.5e-3, 6e-3, 0.2e-3), pressed.points.shape[1:]
    errors = 0.15e-3 * random.normal(size=(len(depths), *shape)) + 0.05e-3 * random.normal(size=(len(depths), 1, 3))
    return shift(scene, interp1d(depths, errors, axis=0)(pressed.states[:, 0]), stddev=np.full(shape, 0.3e-3))


def build_rubbed(bench: Bench, random: np.random.Generator) -> Scene:
    """Press an object of friction 0.4, of which nothing is known, there and back and on again."""
    pressed = press(bench, ramp(5, 3, 6, 2), friction=0.4)
    return film(bench, pressed, tell_height(bench, pressed, 0.3e-3), random, friction=0.45, friction_stddev=0.25)


def build_rubbed_box(bench: Bench, random: np.random.Generator) -> Scene:
    """Press a box of friction 0.6, of which nothing is known, near the tip, there and back and on again."""
    outline = OutlineIndenter((BOX,))
    pressed = press(bench, ramp(3, 2, 4, 2), indenter=outline, shape=0.0, height=0.055, friction=0.6)
    told = tell_outline(bench, pressed, random, BOX)
    return film(bench, pressed, told, random, 0.3, friction=0.45, friction_stddev=0.25)


def build_alike(bench: Bench, random: np.random.Generator) -> Scene:
    """Press, seen by a detector whose noise of 0.3 mm neighbours share, as pixels of a small image make them."""
    scene, rest = build_press(bench, random), bench.jaw.keypoints
    root = np.linalg.cholesky(np.exp(-np.linalg.norm(rest[:, None] - rest, axis=2) / _ALIKE_LENGTH))
    return shift(scene, 0.3e-3 * np.einsum("kj,njc->nkc", root, random.normal(size=(len(scene.images), *rest.shape))))


def build_swaying(bench: Bench, random: np.random.Generator) -> Scene:
    """See the whole jaw in each image shifted and turned by 0.04 mm and 1 mrad, by chance, and rub."""
    scene, rest = build_rubbed(bench, random), bench.jaw.keypoints
    way, turn = 0.04e-3 * random.normal(size=(len(scene.images), 1, 3)), random.normal(size=(len(scene.images), 1, 1))
    return shift(scene, way + 1e-3 * turn * turn_points(rest))


def build_probed(bench: Bench, random: np.random.Generator) -> Scene:
    """Press an object of friction 0.6, of which nothing is known, with a short way back, and hold it."""
    pressed = press(bench, ramp(3, 2.2, 6, hold=60), friction=0.6)
    return film(bench, pressed, tell_height(bench, pressed, 0.3e-3), random, friction=0.45, friction_stddev=0.25)


def build_paused(bench: Bench, random: np.random.Generator) -> Scene:
    """Press an object of friction 0.5 in short strokes with as many stops, and back."""
    levels = (1, 1.5, 2, 2.5, 3, 3.5, 4, 3.9, 3.8, 3.7, 3.9, 4.1)
    pressed = press(bench, ramp(*levels, speed=8e-3, hold=15), friction=0.5)
    return film(bench, pressed, tell_height(bench, pressed), random, friction=0.45, friction_stddev=0.25)


def build_held(bench: Bench, random: np.random.Generator) -> Scene:
    """Hold an object between two jaws alone, low down, where their faces incline most."""
    depths = ramp(5, 3, hold=60)
    pressed = press(bench, depths, height=0.025, along=np.zeros(len(depths)))
    told = tell_height(bench, pressed, 0.3e-3)
    return film(bench, pressed, told, random, friction=0.45, friction_stddev=0.25, **_HELD)


def build_moved(bench: Bench, random: np.random.Generator) -> Scene:
    """Hold an object between two jaws alone, which carry it along the finger as they bend; its pose shows that."""
    depths, polygon = ramp(8, hold=60), circle(_RADIUS)
    told = {"indenter": OutlineIndenter((polygon,)), "shape": 0.0, "along": np.zeros(len(depths))}
    pressed = press(bench, depths, height=0.03 + press(bench, depths, height=0.03, **told).carried, **told)
    contacts = tell_outline(bench, pressed, random, polygon)
    return film(bench, pressed, contacts, random, friction=0.45, friction_stddev=0.25, **_HELD)


def build_fixed(bench: Bench, random: np.random.Generator) -> Scene:
    """Press an object of no friction by two jaws, low down, that something else holds."""
    pressed = press(bench, ramp(5, 3, hold=60), height=0.025)
    return film(bench, pressed, tell_height(bench, pressed, 0.3e-3), random, **_HELD)


def build_handed(bench: Bench, random: np.random.Generator) -> Scene:
    """Press an object by two jaws that something else holds for four seconds, and then nothing."""
    depths = ramp(5, hold=210)
    smooth = press(bench, depths, height=0.025)
    along = np.where(np.arange(len(depths)) < len(depths) - 90, smooth.forces[:, 2], 0.0)
    pressed = press(bench, depths, height=0.025, along=along)
    told = tell_height(bench, pressed, 0.3e-3)
    return film(bench, pressed, told, random, friction=0.45, friction_stddev=0.25, **_HELD)


def build_lifted(bench: Bench, random: np.random.Generator) -> Scene:
    """Lift an object between two jaws, low down, whose weight pulls along the fingers by 1.5 N."""
    depths = ramp(5, hold=180)
    along = np.where(np.arange(len(depths)) >= len(depths) - 90, 1.5, 0.0)
    pressed = press(bench, depths, height=0.025, along=along)
    told = tell_height(bench, pressed, 0.3e-3)
    return film(bench, pressed, told, random, friction=0.9, friction_stddev=0.25, **_HELD)


def build_box(bench: Bench, random: np.random.Generator) -> Scene:
    """Press a box that leans by a degree on its lower edge."""
    pressed = press(bench, ramp(1, 2, 3, 1.5), indenter=OutlineIndenter((BOX,)), shape=0.02)
    return film(bench, pressed, tell_outline(bench, pressed, random, BOX), random)


def build_wide_box(bench: Bench, random: np.random.Generator) -> Scene:
    """Press a box of 50 mm that covers most of the finger."""
    pressed = press(bench, ramp(1, 2.5, 4, 2), indenter=OutlineIndenter((WIDE,)), shape=0.0, height=0.042)
    return film(bench, pressed, tell_outline(bench, pressed, random, WIDE), random)


def build_low_box(bench: Bench, random: np.random.Generator) -> Scene:
    """Press a box of 24 mm whose lower edge leans on the finger next to the clamp."""
    pressed = press(bench, ramp(0.3, 0.6, 0.3), indenter=OutlineIndenter((BOX,)), shape=0.01, height=0.018)
    return film(bench, pressed, tell_outline(bench, pressed, random, BOX), random)


def build_next(bench: Bench, random: np.random.Generator) -> Scene:
    """Press a thick cylinder, let go for a second, and press a thin one elsewhere within what is told of both."""
    first = press(bench, ramp(5, 0, hold=30), shape=22e-3, height=0.022)
    then = press(bench, ramp(5, hold=60)[_TARE + _REST :], shape=5e-3, height=0.027)
    joined = {name: np.concatenate([getattr(each, name) for each in (first, then)])
              for name in ("states", "points", "forces", "carried")}  # fmt: skip
    pressed = Press(**joined)
    return film(bench, pressed, tell_height(bench, pressed, -2.5e-3), random, height_stddev=2.5e-3)


def build_sliding(bench: Bench, random: np.random.Generator) -> Scene:
    """Let a cylinder of 30 mm slide along the finger by 8 mm, which its pose shows."""
    depths, polygon = ramp(4, hold=150), circle(0.015)
    height = 0.045 - 8e-3 * np.linspace(-2.0, 2.0, len(depths)).clip(0.0, 1.0)
    pressed = press(bench, depths, indenter=OutlineIndenter((polygon,)), shape=0.0, height=height)
    return film(bench, pressed, tell_outline(bench, pressed, random, polygon), random)


def build_across(bench: Bench, random: np.random.Generator) -> Scene:
    """Press a cylinder whose middle lies at y = 4 mm."""
    return _load_across(bench, random, 4e-3, 0.0, {})


def build_carried(bench: Bench, random: np.random.Generator) -> Scene:
    """Press a cylinder by two jaws, and lift it so that its weight pulls across the fingers by 0.3 of the force."""
    return _load_across(bench, random, 0.0, 0.3, _HELD)


def build_turned(bench: Bench, random: np.random.Generator) -> Scene:
    """Press a cylinder by two jaws, and roll them once round with its weight; gravity is told."""
    angles = np.r_[np.zeros(10), np.linspace(0.0, 2.0 * np.pi, _LIFTED - 10)]
    gravity = np.stack([np.sin(angles), -np.cos(angles), 0.0 * angles], axis=1)
    scene = _load_across(bench, random, 0.0, 0.2 * gravity[:, 1], _HELD)
    told = np.vstack([np.tile(gravity[:1], (len(scene.images) - _LIFTED, 1)), gravity])
    return replace(
        scene, images=[replace(one, posture=WristPosture(down)) for one, down in zip(scene.images, told, strict=True)]
    )


def _load_across(
    bench: Bench, random: np.random.Generator, y: float, share: float | NDArray, settings: Mapping[str, Any]
) -> Scene:
    """Press a cylinder at y [m], with a lateral force as a share of the normal one in the last `_LIFTED` images."""
    depths, polygon = ramp(4, hold=150), circle(_RADIUS)
    pressed = press(bench, depths, indenter=OutlineIndenter((polygon,)), shape=0.0)
    torsion = measure_torsion(bench.jaw, bench.mechanics.mesh)
    by_moment, by_force, roll = torsion.at(_HEIGHT)
    along_x, lifted = pressed.forces[:, 0], np.zeros(len(depths))
    lifted[-_LIFTED:] = share
    across = along_x**2 * roll * y - lifted * along_x
    points = pressed.points - (y * along_x)[:, None, None] * by_moment + across[:, None, None] * by_force
    forces = pressed.forces + np.outer(across, [0.0, 1.0, 0.0])
    moved = replace(pressed, points=points, forces=forces)
    return film(bench, moved, tell_outline(bench, pressed, random, polygon), random, **settings)


def build_occluded(bench: Bench, random: np.random.Generator) -> Scene:
    """Hide five key points behind the object, on whose surface they are now and then seen with a high likelihood."""
    scene = build_press(bench, random)
    hidden = random.permutation(len(scene.images[0].points))[:5]
    for image in scene.images[_TARE + _REST :]:
        image.points[hidden] += np.array([2e-3, 4e-3, 0.0]) + 1e-3 * random.normal(size=(5, 3))
        image.likelihood[hidden] = np.where(random.random(5) < 0.1, LIKELIHOOD, 0.2)
    return scene


def build_untold(bench: Bench, random: np.random.Generator) -> Scene:
    """Press a relaxing finger at a height that is stated wrong at first, so that no force is told."""
    pressed = press(bench, ramp(6, hold=150))
    scene = film(bench, pressed, tell_height(bench, pressed, 0.3e-3), random)
    wrong = Contact.fixed(bench.jaw, 0.065)
    contacts = [wrong if i < _TARE + _REST + 120 else each for i, each in enumerate(scene.contacts)]
    stamps = np.array([each.stamp for each in scene.images])
    forces = np.stack([_relax(scene.forces[:, a], stamps) for a in range(3)], axis=1)
    return replace(scene, contacts=contacts, forces=forces, relaxation=_RELAXING)


def _relax(elastic: NDArray, stamps: NDArray) -> NDArray:
    """Return what a relaxing finger makes of elastic forces (n,) [N] of one sign at stamps (n,) [s]."""
    from finforce_ifea.relaxation import apply_relaxation

    sign = -1.0 if elastic.sum() < 0.0 else 1.0
    return sign * apply_relaxation(sign * elastic, stamps, _RELAXING)


def build_briefly_tared(bench: Bench, random: np.random.Generator) -> Scene:
    """Tare over five images, and press after five seconds at rest."""
    pressed = press(bench, np.concatenate([np.zeros(120), ramp(3, 5, 2.5)]), height=0.022)
    return film(bench, pressed, tell_height(bench, pressed, 0.3e-3), random, tare_frames=5)


Build = Callable[[Bench, np.random.Generator], Scene]
SCENES: dict[str, Build] = {
    name.removeprefix("build_").replace("_", " "): build
    for name, build in list(globals().items())
    if name.startswith("build_")
}


def build_scene(bench: Bench, name: str) -> Scene:
    """Return a scene by name."""
    return SCENES[name](bench, Plan().random("ablation", name))
