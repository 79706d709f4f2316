"""Stress by contacts: places that switch in every image, places that are wrong, outlines of other objects."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from finforce.errors import FinforceError
from finforce_ifea.observation import Contact, ObjectOutline
from lab.stress.session import Bench, Session, open_session, take_another
from lab.stress.stress import Family, Plan, Trial

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
    """Yields presses with another kind of contact in every image, or in every few."""
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
    """Yields presses whose contact is said to be up to 45 mm away from where it is, or of another object."""
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
    """Yields presses whose contact is told in every form there is, and is right."""
    bench = Bench(plan)
    for seed in range(plan.share(12 * len(RIGHT))):
        random = plan.random("right", seed)
        kind = RIGHT[seed % len(RIGHT)]
        session = open_session(bench, random, level=kind)
        contact = _contact_of(kind, session, random)
        yield from session.play(seed, [replace(step, contact=contact) for step in session.press()])


def run_axes(plan: Plan) -> Iterator[Trial]:
    """Yields presses whose force at a given place has three axes; one refusal where a model is planar."""
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
    """Returns a bench whose loads have three axes; None where the model bends in a plane alone, as a frame does."""
    try:
        bench = Bench(plan, force_axes="three")
    except FinforceError:
        return None
    return bench if bench.estimator.mechanics.model.rotations is None else None


def _contact_of(kind: str, session: Session, random: np.random.Generator) -> Contact | None:
    """Returns the contact of a session in the form, or with the error, that `kind` names."""
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
    """Returns a contact of three heights about the right one, `half` [m] apart, with weights."""
    points = np.repeat(session.contact.points, 3, axis=0)
    points[:, 2] += half * np.array([-1.0, 0.0, 1.0])
    return Contact(points=points, weights=np.array([0.25, 0.5, 0.25]))


def _round(session: Session, height: float, radius: float, tilt: float) -> Contact:
    """Returns a contact with the outline of a cylinder about a height [m]."""
    angles = np.linspace(0.0, 2 * np.pi, CORNERS, endpoint=False)
    circle: NDArray = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    face = session.bench.jaw.inner_face_x
    origin = np.array([face + radius, height])
    outline = ObjectOutline(polygons=(circle,), origin=origin, tilt=tilt, stddev=OUTLINE_STDDEV)
    return Contact(points=np.array([[face, 0.0, height]]), weights=np.ones(1), outline=outline)


FAMILIES = (
    Family(name="contacts", what="another contact in every image", run=run_contacts),
    Family(name="wrong", what="contacts said to be where they are not", run=run_wrong, ruled=False),
    Family(name="right", what="contacts in every form there is", run=run_right),
    Family(name="axes", what="forces in three axes at a given place", run=run_axes),
)
