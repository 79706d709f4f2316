"""Images of an unloaded jaw that an estimator takes before the first true one, so that all is compiled by then."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.observation import Contact, Observation, sketch_contact

_STDDEV = 0.3e-3
_NOISE = 0.05e-3
_EACH = 3
Update = Callable[[Observation, Contact], object]


def rehearse(jaw: Jaw, tare_frames: int, update: Update, reset: Callable[[], None]) -> None:
    """Gives an estimator images with each kind of contact, with stated standard deviations and without.

    Args:
        jaw: the jaw.
        tare_frames: that are taken before the first force.
        update: of the estimator.
        reset: of the same, left reset in the end.
    """
    random = np.random.default_rng(0)
    for stddev in (None, np.full(jaw.keypoints.shape, _STDDEV)):
        reset()
        contacts = list(_imagine_contacts(jaw))
        course = [contacts[0]] * tare_frames + [contact for contact in contacts for _ in range(_EACH)]
        for count, contact in enumerate(course):
            update(_imagine_image(jaw, count / 30.0, stddev, random), contact)
    reset()


def _imagine_contacts(jaw: Jaw) -> Iterator[Contact]:
    """Yields a contact by its height, one by its points, and one by an outline."""
    fixed = Contact.fixed(jaw, float(np.median(jaw.candidates[:, 2])))
    yield from (fixed, replace(fixed, free=False), sketch_contact(jaw))


def _imagine_image(jaw: Jaw, stamp: float, stddev: NDArray | None, random: np.random.Generator) -> Observation:
    points = jaw.keypoints + _NOISE * random.standard_normal(jaw.keypoints.shape)
    return Observation(stamp=stamp, points=points, likelihood=np.ones(len(points)), stddev=stddev)
