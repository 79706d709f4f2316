"""Outlines of simple objects, and the bench finger pressed by them."""

from functools import cache

import numpy as np
from estimator_fakes import ACROSS, ALONG, PERIOD, SIGHT
from mechanics_fakes import BENCH, bench_mechanics

from finforce_ifea.contact_mechanics.forward_press import press_jaw
from finforce_ifea.contact_mechanics.indenter import OutlineIndenter
from finforce_ifea.jaw.jaw import KEYPOINT_DISTANCE
from finforce_ifea.observation import Contact, ObjectOutline, Observation

STDDEV = np.array([1e-4, 1e-4, 3e-3])


def circle(radius, corners=180):
    angles = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    return (radius * np.stack([np.cos(angles), np.sin(angles)], axis=1),)


def box(half_x, half_z):
    return (np.array([[-half_x, -half_z], [half_x, -half_z], [half_x, half_z], [-half_x, half_z]]),)


WEDGE = (np.array([[-0.012, -0.004], [0.02, -0.02], [0.02, 0.02], [-0.006, 0.016]]),)
SHAPES = {"circle": circle(0.0125), "box": box(0.010, 0.0125), "wedge": WEDGE}


def outline(polygons, height, tilt=0.0, x=0.03):
    return ObjectOutline(polygons=polygons, origin=np.array([x, height]), tilt=tilt, stddev=STDDEV)


def contact_with(polygons, height, tilt=0.0):
    point = np.array([[BENCH.inner_face_x, 0.0, height]])
    return Contact(points=point, weights=np.ones(1), outline=outline(polygons, height, tilt))


class Pressed:
    """A known outline at one tilt, for the forward problem; depth counts from first touch."""

    def __init__(self, polygons, tilt):
        self.indenter, self.tilt = OutlineIndenter(polygons), tilt

    def press(self, points, stiffness, face_x, depth, height):
        place = np.array([0.0, self.tilt, height])
        place[0] = depth + self.indenter.find_touch(place, 0.0, 0.08)
        return self.indenter.press(points, stiffness, face_x, place)


@cache
def press_shape(name, height, tilt=0.0, depths=(0.002, 0.004, 0.006)):
    """Equilibria of the bench finger's default mesh."""
    mechanics = bench_mechanics("default", "solid")
    return press_jaw(
        mechanics.model,
        mechanics.contact.surface,
        BENCH.inner_face_x,
        Pressed(SHAPES[name], tilt),
        height,
        depths,
    )


def observe(results, *, rest=60, ramp=15, hold=30, seed=0):
    """Noisy observations of an unloaded jaw that is then pressed to each equilibrium; yields (observation, force)."""
    mechanics = bench_mechanics("default", "solid")
    probe, random = mechanics.model.attach(BENCH.keypoints, KEYPOINT_DISTANCE), np.random.default_rng(seed)
    offsets = 0.2e-3 * random.normal(size=BENCH.keypoints.shape)
    shapes = [(BENCH.keypoints, None)] * rest
    last = BENCH.keypoints
    for result in results:
        points = mechanics.model.positions(probe, result.q)
        shapes += [(last + share * (points - last), None) for share in np.linspace(0, 1, ramp + 1)[1:]]
        shapes += [(points, float(np.linalg.norm(result.force)))] * hold
        last = points
    for i, (points, force) in enumerate(shapes):
        scatter = ACROSS * random.normal(size=points.shape) + ALONG * random.normal(size=(len(points), 1)) * SIGHT
        likelihood = np.full(len(points), 0.9)
        yield Observation(stamp=PERIOD * (i + 1), points=points + scatter + offsets, likelihood=likelihood), force
