"""Stress by what an estimator is given: key points, loads, stamps and contacts.

Few key points, noisy or wrong ones; forces of any size; odd stamps; contacts that switch in every image or are wrong.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from finforce.errors import FinforceError
from finforce_eval.replay.processes import resident_bytes
from finforce_ifea.observation import Contact, ObjectOutline
from lab.stress.session import PERIOD, Bench, Session, SessionStep, noise_of, open_session, take_another
from lab.stress.stress import Family, Plan, Trial

NOISES = (0.0, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
SHARES = (0.1, 0.2, 0.3, 0.4)
USUAL = 0.2
WORKSPACE = 0.03
# Young's modulus of the softest finger that a calibration may have [Pa].
SOFTEST = 1e3
FARTHEST_SHIFT = 0.01


def run_subsets(plan: Plan) -> Iterator[Trial]:
    """Yield trials with random subsets of the key points, down to none; some hidden for good, some now and then."""
    bench = Bench(plan)
    count = len(bench.jaw.keypoints)
    for seed in range(plan.share(3 * (count + 1))):
        random = plan.random("subsets", seed)
        kept, flickers = seed % (count + 1), bool(seed // (count + 1) % 2)
        level = f"{kept:2d} key points, {'others each time' if flickers else 'the same'}"
        session = open_session(bench, random, level=level)
        steps = session.press()
        order = random.permutation(count)
        for step in steps:
            order = random.permutation(count) if flickers else order
            step.points[order[kept:]] = np.nan
        yield from session.play(seed, steps)


def run_noise(plan: Plan) -> Iterator[Trial]:
    """Yield trials with noise from 0 to 10 mm, from the start or only after a tare that saw the usual noise."""
    bench = Bench(plan)
    for seed in range(plan.share(6 * len(NOISES))):
        random = plan.random("noise", seed)
        noise, late = NOISES[seed % len(NOISES)], bool(seed // len(NOISES) % 2)
        level = f"{noise:g} mm {'after the tare' if late else 'from the start'}"
        session = open_session(bench, random, tare=1.0 if late else noise / USUAL, level=level)
        yield from session.play(seed, session.press(scale=noise / USUAL))


def run_gross(plan: Plan) -> Iterator[Trial]:
    """Yield trials in which a share of the key points lies anywhere in the workspace, with high likelihood."""
    bench = Bench(plan)
    for seed in range(plan.share(10 * len(SHARES))):
        random = plan.random("gross", seed)
        share, lasts = SHARES[seed % len(SHARES)], bool(seed // len(SHARES) % 2)
        session = open_session(bench, random, level=f"{100 * share:g} %, {'lasting' if lasts else 'drawn anew'}")
        steps = session.press()
        wrong, places = _draw_wrong(bench, random, share), _draw_places(bench, random)
        for step in steps:
            if not lasts:
                wrong, places = _draw_wrong(bench, random, share), _draw_places(bench, random)
            step.points[wrong] = places[wrong] + noise_of(random, (len(wrong),))
        yield from session.play(seed, steps)


def run_clusters(plan: Plan) -> Iterator[Trial]:
    """Yield trials in which a share of the key points errs together: shifted alike, or as of another press."""
    bench = Bench(plan)
    for seed in range(plan.share(10 * len(SHARES))):
        random = plan.random("clusters", seed)
        share, alike = SHARES[seed % len(SHARES)], bool(seed // len(SHARES) % 2)
        session = open_session(bench, random, level=f"{100 * share:g} %, {'shifted' if alike else 'another press'}")
        steps = session.press()
        wrong = _draw_wrong(bench, random, share)
        shift = random.uniform(-FARTHEST_SHIFT, FARTHEST_SHIFT, 3)
        other = bench.press(random)
        elsewhere = other.keypoints(other.depth)[wrong]
        for step in steps[int(random.integers(0, len(steps) - 5)) :]:
            if alike:
                step.points[wrong] += shift
            else:
                step.points[wrong] = elsewhere + noise_of(random, (len(wrong),))
        yield from session.play(seed, steps)


def _draw_wrong(bench: Bench, random: np.random.Generator, share: float) -> NDArray:
    """Return the indices of the key points that are wrong."""
    count = len(bench.jaw.keypoints)
    return random.permutation(count)[: round(share * count)]


def _draw_places(bench: Bench, random: np.random.Generator) -> NDArray:
    """Return places (K, 3) [m] anywhere in the workspace."""
    return bench.jaw.keypoints + random.uniform(-WORKSPACE, WORKSPACE, bench.jaw.keypoints.shape)


FORCES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3)
JUMPS = ("teleport", "walk", "alternate", "between presses")
DEPTH, LEAST_DEPTH, RADIUS = 4e-3, 1e-4, 12e-3


def run_forces(plan: Plan) -> Iterator[Trial]:
    """Yield presses with 1e-4 to 1e3 N: on jaws that it bends by millimetres, and on the usual one up to 1 N."""
    usual = Bench(plan)
    for seed in range(plan.share(2 * len(FORCES))):
        random = plan.random("forces", seed)
        force = FORCES[seed % len(FORCES)]
        height = random.uniform(0.02, 0.06)
        history = usual.history(height=height, radius=RADIUS, depth=DEPTH)
        full = float(np.linalg.norm(history.forces(DEPTH)))
        if seed // len(FORCES) % 2 and force < full:
            bench, level = usual, f"{force:g} N, the usual jaw"
            depth = DEPTH * force / full
            history = replace(bench.history(height=height, radius=RADIUS, depth=max(depth, LEAST_DEPTH)), depth=depth)
        else:
            softer = max(force / full, SOFTEST / usual.jaw.material.young_modulus)
            bench, level = Bench(plan, modulus=softer), f"{force:g} N, a jaw to match"
            history = bench.history(height=height, radius=RADIUS, depth=DEPTH)
        session = open_session(bench, random, history=history, level=level)
        yield from session.play(seed, session.press())


def run_model_error(plan: Plan) -> Iterator[Trial]:
    """Yield presses of a jaw whose key points move by 1 % more or less each, and whose force is 1 % off."""
    bench = Bench(plan)
    for seed in range(plan.share(30)):
        random = plan.random("model", seed)
        session = open_session(bench, random, level="1 %")
        stretch, stiffer = 0.01 * random.normal(size=(len(bench.jaw.keypoints), 1)), 1 + 0.01 * random.normal()
        steps = []
        for step in session.press():
            way = step.points - bench.jaw.keypoints - session.offsets
            steps.append(
                replace(
                    step, points=step.points + stretch * way, force=stiffer * step.force, torque=stiffer * step.torque
                )
            )
        yield from session.play(seed, steps)


def run_jumps(plan: Plan) -> Iterator[Trial]:
    """Yield loads that jump: to any depth, in a random walk, on and off, from one press to another."""
    bench = Bench(plan)
    for seed in range(plan.share(8 * len(JUMPS))):
        random = plan.random("jumps", seed)
        kind = JUMPS[seed % len(JUMPS)]
        session = open_session(bench, random, level=kind)
        yield from session.play(seed, _jump(session, kind, random))


def _jump(session: Session, kind: str, random: np.random.Generator, count: int = 60) -> list[SessionStep]:
    """Return `count` steps whose depth changes as `kind` says."""
    deepest = session.history.depth
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


STAMPS = ("jitter", "gaps", "stall", "repeat", "backwards", "not finite")
LONGEST_GAP = 1e5
SHORTEST = 1e-9
MANY = 20_000
# One in so many steps of the long run is kept: what is kept must not be what grows.
KEPT = 10
PRESSES = 8


def run_stamps(plan: Plan) -> Iterator[Trial]:
    """Yield presses whose stamps are not those of a camera."""
    bench = Bench(plan)
    for seed in range(plan.share(8 * len(STAMPS))):
        random = plan.random("stamps", seed)
        kind = STAMPS[seed % len(STAMPS)]
        session = open_session(bench, random, level=kind)
        steps = session.press()
        stamps = session.start + np.cumsum(_draw_periods(kind, random, len(steps)))
        yield from session.play(seed, [replace(s, stamp=float(t)) for s, t in zip(steps, stamps, strict=True)])


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
WRONG = (
    "wrong height",
    "wrong outline",
    "larger outline",
    "wrong fixed",
    "outline and height in turn",
    "of the object before",
)
RIGHT = ("height", "outline", "fixed", "regions")
OUTLINE_STDDEV = np.array([1e-4, 3e-4, 3e-3])
CORNERS = 90
FARTHEST = 0.045


def run_contacts(plan: Plan) -> Iterator[Trial]:
    """Yield presses with another kind of contact in every image, or in every few."""
    bench = Bench(plan)
    for seed in range(plan.share(30)):
        random = plan.random("contacts", seed)
        lasts = (1, 2, 5, 12)[seed % 4]
        session = open_session(bench, random, level=f"another every {lasts} images")
        offered = {kind: _contact_of(kind, session, random) for kind in KINDS}
        steps, kind = [], "height"
        for index, step in enumerate(session.press() + session.press()):
            kind = KINDS[int(random.integers(len(KINDS)))] if index % lasts == 0 else kind
            steps.append(replace(step, stamp=session.start + (index + 1) / 30, contact=offered[kind]))
        yield from session.play(seed, steps)


def run_wrong(plan: Plan) -> Iterator[Trial]:
    """Yield presses whose contact is said to be up to 45 mm away from where it is, or of another object."""
    bench = Bench(plan)
    for seed in range(plan.share(12 * len(WRONG))):
        random = plan.random("wrong", seed)
        kind = WRONG[seed % len(WRONG)]
        session = open_session(bench, random, level=kind)
        first, second = _contact_of(kind, session, random), session.contact
        steps = session.press()
        if kind == "of the object before":
            later, last = take_another(session, random).press(), steps[-1].stamp - session.start
            yield from session.play(seed, steps)
            steps = [replace(step, stamp=step.stamp + last) for step in later]
            first = session.contact
        for index, step in enumerate(steps):
            given = second if kind == "outline and height in turn" and index % 2 else first
            steps[index] = replace(step, contact=given)
        yield from session.play(seed, steps)


def run_right(plan: Plan) -> Iterator[Trial]:
    """Yield presses whose contact is told in every form there is, and is right."""
    bench = Bench(plan)
    for seed in range(plan.share(12 * len(RIGHT))):
        random = plan.random("right", seed)
        kind = RIGHT[seed % len(RIGHT)]
        session = open_session(bench, random, level=kind)
        contact = _contact_of(kind, session, random)
        yield from session.play(seed, [replace(step, contact=contact) for step in session.press()])


def run_axes(plan: Plan) -> Iterator[Trial]:
    """Yield presses whose force at a given place has three axes; one refusal where a model is planar."""
    bench = _build_three(plan)
    if bench is None:
        yield Trial(level="planar model", outcome="refused", note="forces in three axes need a solid")
        return
    for seed in range(plan.share(12)):
        random = plan.random("axes", seed)
        session = open_session(bench, random, level="three axes")
        contact = _contact_of("fixed", session, random)
        yield from session.play(seed, [replace(step, contact=contact) for step in session.press()])


def _build_three(plan: Plan) -> Bench | None:
    """Return a bench whose loads have three axes; None where the model bends in a plane alone, as a frame does."""
    try:
        bench = Bench(plan, force_axes="three")
    except FinforceError:
        return None
    return bench if bench.estimator.mechanics.model.rotations is None else None


def _contact_of(kind: str, session: Session, random: np.random.Generator) -> Contact | None:
    """Return the contact of a session in the form, or with the error, that `kind` names."""
    height, radius = session.history.height, session.history.radius
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
        case "fixed":
            return replace(session.contact, free=False)
        case "wrong fixed":
            return replace(Contact.fixed(session.bench.jaw, away), free=False)
        case "regions":
            return _region(session, 3e-3)
        case "outline":
            error = OUTLINE_STDDEV * random.normal(size=3)
            return _round(session, height + error[1], radius, error[2])
        case "larger outline":
            return _round(session, height, radius * random.uniform(1.5, 3.0), 0.0)
        case _:
            return _round(session, away, radius, 0.0)


def _region(session: Session, half: float) -> Contact:
    """Return a contact of three heights about the right one, `half` [m] apart, with weights."""
    points = np.repeat(session.contact.points, 3, axis=0)
    points[:, 2] += half * np.array([-1.0, 0.0, 1.0])
    return Contact(points=points, weights=np.array([0.25, 0.5, 0.25]))


def _round(session: Session, height: float, radius: float, tilt: float) -> Contact:
    """Return a contact with the outline of a cylinder about a height [m]."""
    angles = np.linspace(0.0, 2 * np.pi, CORNERS, endpoint=False)
    circle: NDArray = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    face = session.bench.jaw.inner_face_x
    origin = np.array([face + radius, height])
    outline = ObjectOutline(polygons=(circle,), origin=origin, tilt=tilt, stddev=OUTLINE_STDDEV)
    return Contact(points=np.array([[face, 0.0, height]]), weights=np.ones(1), outline=outline)


FAMILIES = (
    Family(name="subsets", what="random subsets of the key points, down to none", run=run_subsets),
    Family(name="noise", what="key point noise from 0 to 10 mm, known to the tare or not", run=run_noise),
    Family(name="gross", what="up to 40 % of the key points anywhere in the workspace", run=run_gross),
    Family(name="clusters", what="up to 40 % of the key points wrong together", run=run_clusters),
    Family(name="forces", what="forces from 1e-4 to 1e3 N", run=run_forces, timed=False),
    Family(name="model", what="a jaw that is 1 % off its model", run=run_model_error),
    Family(name="jumps", what="targets that jump between images", run=run_jumps),
    Family(name="stamps", what="stamps that stall, jitter, repeat or leap", run=run_stamps),
    Family(name="long", what="one in ten of many steps without a new start", run=run_long),
    Family(name="contacts", what="another contact in every image", run=run_contacts),
    Family(name="wrong", what="contacts said to be where they are not", run=run_wrong, ruled=False),
    Family(name="right", what="contacts in every form there is", run=run_right),
    Family(name="axes", what="forces in three axes at a given place", run=run_axes),
)
