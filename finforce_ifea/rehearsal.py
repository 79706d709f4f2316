"""Images of an unloaded jaw that an estimator takes before the first true one, so that all is compiled by then."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.jaw import Jaw
from finforce_ifea.observation import Contact, Observation, sketch_contact

_STDDEV = 0.3e-3
_NOISE = 0.05e-3
_AFTER_TARE = 3


def rehearse(jaw: Jaw, tare_frames: int, update: Callable[[Observation, Contact], object]) -> None:
    """Gives an estimator images with each kind of contact, with stated standard deviations and without.

    Args:
        jaw: the jaw.
        tare_frames: that are taken before the first force.
        update: of an estimator that is reset before and after; stamps rise.
    """
    random, stamp = np.random.default_rng(0), 0.0
    for stddev in (None, np.full(jaw.keypoints.shape, _STDDEV)):
        for contact in _imagine_contacts(jaw):
            for _ in range(tare_frames + _AFTER_TARE):
                stamp += 1.0 / 30.0
                update(_imagine_image(jaw, stamp, stddev, random), contact)


def _imagine_contacts(jaw: Jaw) -> Iterator[Contact]:
    """Yields a contact by its height, one by its points, and one by an outline."""
    fixed = Contact.fixed(jaw, float(np.median(jaw.candidates[:, 2])))
    yield from (fixed, replace(fixed, free=False), sketch_contact(jaw))


def _imagine_image(jaw: Jaw, stamp: float, stddev: NDArray | None, random: np.random.Generator) -> Observation:
    points = jaw.keypoints + _NOISE * random.standard_normal(jaw.keypoints.shape)
    return Observation(stamp=stamp, points=points, likelihood=np.ones(len(points)), stddev=stddev)
