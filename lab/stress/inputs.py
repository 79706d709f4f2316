"""Stress by what an estimator is given: key points, loads, stamps and contacts.

Few key points, noisy or wrong ones; forces of any size; odd stamps; contacts that switch in every image or are wrong;
and what goes wrong around a jaw: a camera that is bumped or hangs, points that creep, contacts that walk.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.errors import FinforceError
from finforce_eval.replay.process_group import resident_bytes
from finforce_ifea.observation import Contact, ObjectOutline
from lab.stress.session import PERIOD, Bench, Session, SessionStep, noise_of, open_session, take_another
from lab.stress.stress import Family, Plan, Trial

Disturb = Callable[[Session, Any], Iterable[SessionStep]]


def press_family(
    name: str,
    what: str,
    levels: Callable[[Bench], Mapping[str, Any]],
    disturb: Disturb,
    *,
    rounds: int,
    tare: Callable[[Any], float] = lambda setting: 1.0,
    build: Callable[[Plan], Bench | None] = Bench,
    **rules: Any,
) -> Family:
    """Return a family of presses that are disturbed, one level after the other.

    Args:
        name: of the family.
        what: is done.
        levels: setting of each level by its name.
        disturb: returns the steps of a press at a setting; all chance is the session's.
        rounds: trials of each level.
        tare: noise of the tare at a setting, in that of a bench camera.
        build: returns the bench; None where the plan's model cannot have the family.
        rules: of `Family`.
    """

    def run(plan: Plan) -> Iterator[Trial]:
        bench = build(plan)
        if bench is None:
            yield Trial(level="planar model", outcome="refused", note="forces in three axes need a solid")
            return
        settings = list(levels(bench).items())
        for seed in range(plan.share(rounds * len(settings))):
            level, setting = settings[(seed + plan.seed) % len(settings)]  # few trials of another seed see others
            session = open_session(bench, plan.random(name, seed), tare=tare(setting), level=level)
            yield from session.play(seed, disturb(session, setting))

    return Family(name=name, what=what, run=run, **rules)


NOISES = (0.0, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)  # [mm]
SHARES = (0.1, 0.2, 0.3, 0.4)
USUAL = 0.2  # [mm]
WORKSPACE = 0.03
FARTHEST_SHIFT = 0.01


def list_subsets(bench: Bench) -> Mapping[str, Any]:
    """Return how many key points are kept, down to none, and whether they are others in each image."""
    words = {False: "the same", True: "others each time"}
    counts = range(len(bench.jaw.keypoints) + 1)
    return {f"{kept:2d} key points, {words[flickers]}": (kept, flickers) for flickers, kept in product(words, counts)}


def hide_others(session: Session, setting: tuple[int, bool]) -> Iterable[SessionStep]:
    """Return a press of which a random subset of the key points is seen; some hidden for good, some now and then."""
    (kept, flickers), steps = setting, session.press()
    count = len(session.bench.jaw.keypoints)
    order = session.random.permutation(count)
    for step in steps:
        order = session.random.permutation(count) if flickers else order
        step.points[order[kept:]] = np.nan
    return steps


def list_noises(_: Bench) -> Mapping[str, Any]:
    """Return noise [mm] from the start, or only after a tare that saw the usual noise."""
    words = {False: "from the start", True: "after the tare"}
    return {f"{noise:g} mm {words[late]}": (noise, late) for late, noise in product(words, NOISES)}


def list_shares(usual: str, lasting: str) -> Callable[[Bench], Mapping[str, Any]]:
    """Return shares of the key points that are wrong, in one way and in another."""
    words = {False: usual, True: lasting}
    levels = {f"{100 * share:g} %, {words[kind]}": (share, kind) for kind, share in product(words, SHARES)}
    return lambda _: levels


def throw_points(session: Session, setting: tuple[float, bool]) -> Iterable[SessionStep]:
    """Return a press in which a share of the key points lies anywhere in the workspace, with high likelihood."""
    (share, lasts), steps, random = setting, session.press(), session.random
    wrong, places = draw_wrong(session, share), _draw_places(session)
    for step in steps:
        if not lasts:
            wrong, places = draw_wrong(session, share), _draw_places(session)
        step.points[wrong] = places[wrong] + noise_of(random, (len(wrong),))
    return steps


def err_together(session: Session, setting: tuple[float, bool]) -> Iterable[SessionStep]:
    """Return a press in which a share of the key points errs together: shifted alike, or as of another press."""
    (share, alike), steps, random = setting, session.press(), session.random
    wrong = draw_wrong(session, share)
    shift = random.uniform(-FARTHEST_SHIFT, FARTHEST_SHIFT, 3)
    other = session.bench.press(random)
    elsewhere = other.keypoints(other.depth)[wrong]
    for step in steps[int(random.integers(0, len(steps) - 5)) :]:
        if alike:
            step.points[wrong] += shift
        else:
            step.points[wrong] = elsewhere + noise_of(random, (len(wrong),))
    return steps


def draw_wrong(session: Session, share: float) -> NDArray:
    """Return the indices of the key points that are wrong."""
    count = len(session.bench.jaw.keypoints)
    return session.random.permutation(count)[: round(share * count)]


def _draw_places(session: Session) -> NDArray:
    """Return places (K, 3) [m] anywhere in the workspace."""
    rest = session.bench.jaw.keypoints
    return rest + session.random.uniform(-WORKSPACE, WORKSPACE, rest.shape)


FORCES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3)
DEPTH, LEAST_DEPTH, RADIUS = 4e-3, 1e-4, 12e-3
# Young's modulus of the softest finger that a calibration may have [Pa].
SOFTEST = 1e3


def run_forces(plan: Plan) -> Iterator[Trial]:
    """Yield presses with 1e-4 to 1e3 N: on jaws that it bends by millimetres, and on the usual one up to 1 N."""
    usual = Bench(plan)
    for seed in range(plan.share(2 * len(FORCES))):
        random = plan.random("forces", seed)
        force = FORCES[seed % len(FORCES)]
        height = random.uniform(0.02, 0.06)
        history = usual.history(height=height, radius=RADIUS, depth=DEPTH)
        full = float(np.linalg.norm(history.forces(history.depth)))
        if seed // len(FORCES) % 2 and force < full:
            bench, level = usual, f"{force:g} N, the usual jaw"
            depth = DEPTH * force / full
            history = bench.history(height=height, radius=RADIUS, depth=max(depth, LEAST_DEPTH))
            history = replace(history, depth=bench.find_depth(depth))
        else:
            softer = max(force / full, SOFTEST / usual.jaw.material.young_modulus)
            bench, level = Bench(plan, modulus=softer), f"{force:g} N, a jaw to match"
            history = bench.history(height=height, radius=RADIUS, depth=DEPTH)
        session = open_session(bench, random, history=history, level=level)
        yield from session.play(seed, session.press())


def bend_otherwise(session: Session, _: None) -> Iterable[SessionStep]:
    """Yield a press of a jaw whose key points move by 1 % more or less each, and whose force is 1 % off."""
    random, rest = session.random, session.bench.jaw.keypoints + session.offsets
    stretch, stiffer = 0.01 * random.normal(size=(len(rest), 1)), 1 + 0.01 * random.normal()
    for step in session.press():
        points = step.points + stretch * (step.points - rest)
        yield replace(step, points=points, force=stiffer * step.force, torque=stiffer * step.torque)


def same(*kinds: str) -> Callable[[Bench], Mapping[str, Any]]:
    """Return levels that are called like their settings."""
    return lambda _: dict(zip(kinds, kinds, strict=True))


def jump(session: Session, kind: str, count: int = 60) -> list[SessionStep]:
    """Return `count` steps whose depth jumps: to any depth, in a random walk, on and off, from one press to another."""
    deepest, random = session.history.depth, session.random
    if kind == "teleport":
        return session.steps(np.repeat(random.uniform(0.0, deepest, count // 4), 4))
    if kind == "walk":
        walk = np.cumsum(random.normal(0.0, 0.2 * deepest, count))
        return session.steps(np.abs((walk + deepest) % (2 * deepest) - deepest))
    if kind == "alternate":
        return session.steps(np.where(np.arange(count) % 2, deepest, 0.0))
    other = take_another(session, random)
    first, second = session.steps(np.full(count, deepest)), other.steps(np.full(count, other.history.depth))
    return [pair[i // 10 % 2] for i, pair in enumerate(zip(first, second, strict=True))]


LONGEST_GAP = 1e5
SHORTEST = 1e-9


def stamp_otherwise(session: Session, kind: str) -> Iterable[SessionStep]:
    """Return a press whose stamps are not those of a camera."""
    steps = session.press()
    stamps = session.start + np.cumsum(_draw_periods(kind, session.random, len(steps)))
    return [replace(step, stamp=float(stamp)) for step, stamp in zip(steps, stamps, strict=True)]


def _draw_periods(kind: str, random: np.random.Generator, count: int) -> np.ndarray:
    """Return the time [s] from each image to the next."""
    periods = np.full(count, PERIOD)
    odd = random.random(count) < 0.3
    match kind:
        case "jitter":
            return PERIOD * random.uniform(0.05, 3.0, count)
        case "gaps":
            periods[odd] = np.exp(random.uniform(np.log(PERIOD), np.log(LONGEST_GAP), odd.sum()))
        case "stall":
            periods[odd] = SHORTEST
        case "repeat":
            periods[odd] = 0.0
        case "backwards":
            periods[odd] = -random.uniform(0.0, 3 * PERIOD, odd.sum())
        case _:
            periods[-1] = np.nan if random.random() < 0.5 else np.inf
    return periods


MANY = 20_000
# One in so many steps of the long run is kept: what is kept must not be what grows.
KEPT = 10
PRESSES = 8


def run_long(plan: Plan) -> Iterator[Trial]:
    """Yield one in ten steps of a long run of presses; each tenth of the run is a level, so that drift shows."""
    bench, random = Bench(plan), plan.random("long")
    session = open_session(bench, random)
    presses = [session, *(take_another(session, random) for _ in range(PRESSES - 1))]
    total = plan.share(MANY)
    done, worst, nan, memory = 0, 0.0, False, resident_bytes()
    for trial in session.play(plan.seed, _press_on(presses, random, total)):
        done, worst, nan = done + 1, float(np.fmax(worst, trial.step_time)), nan or trial.nan
        if done % KEPT == 0 or done == total:
            grown = f"memory {(resident_bytes() - memory) / 1e6:+.1f} MB" if done == total else ""
            note = grown or (trial.note if trial.sigmas > 3.0 else "")
            tenth = f"tenth {min(10, 1 + 10 * (done - 1) // total):2d} of {total} steps"
            yield replace(trial, step_time=worst, nan=nan, level=tenth, note=note)
            worst, nan = 0.0, False


def _press_on(presses: list[Session], random: np.random.Generator, count: int) -> Iterator[SessionStep]:
    """Yield `count` steps: rest, a ramp, a hold, a ramp back, with one press after the other."""
    done = 0
    while done < count:
        session = presses[int(random.integers(len(presses)))]
        depth = random.uniform(0.2, 1.0) * session.history.depth
        up = np.linspace(0.0, depth, int(random.integers(5, 40)))
        depths = np.concatenate([np.zeros(20), up, np.full(int(random.integers(10, 90)), depth), up[::-1]])
        for step in session.steps(depths)[: count - done]:
            done += 1
            yield replace(step, stamp=session.start + done * PERIOD)


KINDS = ("height", "outline", "fixed", "none", "no rows", "regions")
OUTLINE_STDDEV = np.array([1e-4, 3e-4, 3e-3])
CORNERS = 90
FARTHEST = 0.045


def list_changes(_: Bench) -> Mapping[str, Any]:
    """Return for how many images a contact lasts."""
    return {f"another every {lasts} images": lasts for lasts in (1, 2, 5, 12)}


def switch_contacts(session: Session, lasts: int) -> Iterable[SessionStep]:
    """Yield two presses with another kind of contact in every image, or in every few."""
    offered = {kind: _contact_of(kind, session) for kind in KINDS}
    kind = "height"
    for index, step in enumerate(session.press() + session.press()):
        kind = KINDS[int(session.random.integers(len(KINDS)))] if index % lasts == 0 else kind
        yield replace(step, stamp=session.start + (index + 1) * PERIOD, contact=offered[kind])


def tell_contact(session: Session, kind: str) -> Iterable[SessionStep]:
    """Return a press whose contact is told in a form, right or wrong."""
    first, second, steps = _contact_of(kind, session), session.contact, session.press()
    if kind == "of the object before":
        last = steps[-1].stamp - session.start
        later = take_another(session, session.random).press()
        return steps + [replace(step, stamp=step.stamp + last, contact=second) for step in later]
    in_turn = kind == "outline and height in turn"
    return [replace(step, contact=second if in_turn and i % 2 else first) for i, step in enumerate(steps)]


def _build_three(plan: Plan) -> Bench | None:
    """Return a bench whose loads have three axes; None where the model bends in a plane alone, as a frame does."""
    try:
        bench = Bench(plan, force_axes="three", friction=0.4, friction_stddev=0.2)  # which is how these loads lean
    except FinforceError:
        return None
    return bench if bench.estimator.mechanics.model.rotations is None else None


def _contact_of(kind: str, session: Session) -> Contact | None:
    """Return the contact of a session in the form, or with the error, that `kind` names."""
    height, radius, random = session.history.height, session.history.radius, session.random
    heights = session.bench.jaw.candidates[:, 2]
    away = float(np.clip(height + random.choice((-1, 1)) * random.uniform(5e-3, FARTHEST), heights[0], heights[-1]))
    match kind:
        case "none":
            return None
        case "no rows":
            return Contact(points=np.zeros((0, 3)), weights=np.zeros(0))
        case "height":
            return session.contact
        case "wrong height":
            return Contact.fixed(session.bench.jaw, away)
        case "fixed" | "three axes":
            return replace(session.contact, free=False)
        case "wrong fixed":
            return replace(Contact.fixed(session.bench.jaw, away), free=False)
        case "regions":
            points = np.repeat(session.contact.points, 3, axis=0)
            points[:, 2] += 3e-3 * np.array([-1.0, 0.0, 1.0])
            return Contact(points=points, weights=np.array([0.25, 0.5, 0.25]))
        case "outline":
            error = OUTLINE_STDDEV * random.normal(size=3)
            return _round(session, height + error[1], radius, error[2])
        case "larger outline":
            return _round(session, height, radius * random.uniform(1.5, 3.0), 0.0)
        case _:
            return _round(session, away, radius, 0.0)


def _round(session: Session, height: float, radius: float, tilt: float) -> Contact:
    """Return a contact with the outline of a cylinder about a height [m]."""
    angles = np.linspace(0.0, 2 * np.pi, CORNERS, endpoint=False)
    circle: NDArray = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    face = session.bench.jaw.inner_face_x
    origin = np.array([face + radius, height])
    outline = ObjectOutline(polygons=(circle,), origin=origin, tilt=tilt, stddev=OUTLINE_STDDEV)
    return Contact(points=np.array([[face, 0.0, height]]), weights=np.ones(1), outline=outline)


Upset = Callable[[Session, list[SessionStep]], list[SessionStep]]
HOLD = 80
# Images of rest before an upset, and a time before which it comes.
FIRST, LAST = 4, 50
CAMERA_DISTANCE = 0.11
CREEPING, CREEP = 5, 0.1e-3
WALK = 2e-3
TOGETHER = 8 / 15


def upset_hold(session: Session, upset: Upset) -> Iterable[SessionStep]:
    """Return a press in which something goes wrong, mostly while it is held."""
    steps = session.press(hold=HOLD)
    start = int(session.random.integers(FIRST, LAST))
    return steps[:start] + upset(session, steps[start:])


def bump_camera(shift: float, turn: float) -> Upset:
    """Return what moves all key points as a camera that is shifted [m] and turned [rad] does."""

    def bump(session: Session, steps: list[SessionStep]) -> list[SessionStep]:
        way, axis = (_draw_way(session, length) for length in (shift, turn))
        camera = session.bench.jaw.keypoints.mean(0) + [0.0, CAMERA_DISTANCE, 0.0]
        return [replace(s, points=s.points + way + np.cross(axis, s.points - camera)) for s in steps]

    return bump


def let_points_creep(session: Session, steps: list[SessionStep]) -> list[SessionStep]:
    """Let five key points creep, each its own way."""
    creeping = session.random.permutation(len(session.bench.jaw.keypoints))[:CREEPING]
    way = np.stack([_draw_way(session, CREEP) for _ in creeping])
    for index, step in enumerate(steps):
        step.points[creeping] += way * (index + 1)
    return steps


def let_contact_walk(session: Session, steps: list[SessionStep]) -> list[SessionStep]:
    """Let the stated contact walk along the jaw, which the force does not."""
    heights = session.bench.jaw.candidates[:, 2]
    walk = session.random.choice([-WALK, WALK]) * np.arange(1, len(steps) + 1)
    walked = np.clip(session.history.height + walk, heights[0], heights[-1])
    return [
        replace(step, contact=Contact.fixed(session.bench.jaw, float(height)))
        for step, height in zip(steps, walked, strict=True)
    ]


def shift_most(session: Session, steps: list[SessionStep]) -> list[SessionStep]:
    """Shift more than half of the key points alike."""
    wrong = draw_wrong(session, TOGETHER)
    shift = session.random.uniform(-FARTHEST_SHIFT, FARTHEST_SHIFT, 3)
    for step in steps:
        step.points[wrong] += shift
    return steps


def _draw_way(session: Session, length: float) -> NDArray:
    """Return a vector (3,) of some length in any direction."""
    way = session.random.normal(size=3)
    return way * (length / np.linalg.norm(way))


UPSETS: dict[str, Upset] = {
    "camera moved by 0.5 mm": bump_camera(0.5e-3, 0.0),
    "camera moved by 2 mm": bump_camera(2e-3, 0.0),
    "camera turned by 1 degree": bump_camera(0.0, np.radians(1.0)),
    "five points creep": let_points_creep,
    "stated contact walks": let_contact_walk,
    "more than half of the points off together": shift_most,
}


JUMPS = ("teleport", "walk", "alternate", "between presses")
STAMPS = ("jitter", "gaps", "stall", "repeat", "backwards", "not finite")
WRONG = (
    "wrong height",
    "wrong outline",
    "larger outline",
    "wrong fixed",
    "outline and height in turn",
    "of the object before",
)
RIGHT = ("height", "outline", "fixed", "regions")
FAMILIES = (
    press_family("subsets", "random subsets of the key points, down to none", list_subsets, hide_others, rounds=2),
    press_family(
        "noise",
        "key point noise from 0 to 10 mm, known to the tare or not",
        list_noises,
        lambda session, setting: session.press(scale=setting[0] / USUAL),
        tare=lambda setting: 1.0 if setting[1] else setting[0] / USUAL,
        rounds=3,
    ),
    press_family(
        "gross",
        "up to 40 % of the key points anywhere in the workspace",
        list_shares("drawn anew", "lasting"),
        throw_points,
        rounds=5,
    ),
    press_family(
        "clusters",
        "up to 40 % of the key points wrong together",
        list_shares("another press", "shifted"),
        err_together,
        rounds=5,
    ),
    Family(name="forces", what="forces from 1e-4 to 1e3 N", run=run_forces, timed=False),
    press_family("model", "a jaw that is 1 % off its model", lambda _: {"1 %": None}, bend_otherwise, rounds=30),
    press_family("jumps", "targets that jump between images", same(*JUMPS), jump, rounds=8),
    press_family("stamps", "stamps that stall, jitter, repeat or leap", same(*STAMPS), stamp_otherwise, rounds=8),
    Family(name="long", what="one in ten of many steps without a new start", run=run_long),
    press_family("contacts", "another contact in every image", list_changes, switch_contacts, rounds=8),
    press_family("wrong", "wrong contact locations", same(*WRONG), tell_contact, rounds=12, ruled=False),
    press_family("right", "contacts in every form there is", same(*RIGHT), tell_contact, rounds=12),
    press_family(
        "axes",
        "forces in three axes at a given place",
        same("three axes"),
        tell_contact,
        rounds=12,
        build=_build_three,
    ),
    press_family(
        "upsets",
        "bumped cameras, creeping points, walking contacts",
        lambda _: UPSETS,
        upset_hold,
        rounds=8,
        ruled=False,
    ),
)
