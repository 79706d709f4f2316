"""The Cramér-Rao bound in cases whose bound is known."""

from dataclasses import replace

import numpy as np
import pytest

from finforce_ifea.contact_mechanics.friction import Coefficient
from lab.bound import NOISE_ALONE, Stated, TrueImages, bound_forces

COUNT, NOISE, STIFFNESS = 5, 0.2e-3, 400.0
# The depth of an image before anything is seen, 1 sigma [m].
FREE = 2e-3
EXACT = replace(NOISE_ALONE, tilt=0.0, drift=0.0)


def hold(images=1, noise=NOISE, offset=0.0, friction=0.0, traction=0.0):
    """A jaw held at 3 mm: key points follow the depth along x, the force is proportional to it."""
    motions, modes = np.zeros((images, COUNT, 2, 4)), np.zeros((images, 3, 4))
    motions[:, :, 0, 0], modes[:, 0, 0], modes[:, 2, 3] = -np.linspace(0.2, 1.0, COUNT), -STIFFNESS, traction
    return TrueImages(
        stamps=np.arange(images) / 30.0,
        depth=np.full(images, 3e-3),
        mobilization=np.ones(images),
        motions=motions,
        displacement=np.full((images, COUNT), 1e-3),
        places=np.zeros((images, COUNT, 2)),
        modes=modes,
        seen=np.ones((images, COUNT), bool),
        noise=noise**2 * np.eye(2),
        offset_variance=np.full(COUNT, offset**2),
        pose=np.zeros(2),
        friction=Coefficient(0.0, friction),
    )


def expect(images=1, noise=NOISE):
    """The analytic bound of the force along x: one number, seen by all key points, with a prior."""
    information = images * (np.linspace(0.2, 1.0, COUNT) ** 2).sum() / noise**2 + FREE**-2.0
    return STIFFNESS / np.sqrt(information)


def along_x(images, stated=EXACT):
    return float(np.sqrt(bound_forces(images, stated)[-1, 0, 0]))


@pytest.mark.parametrize("images", [1, 30])
def test_it_is_the_analytic_one_where_only_noise_counts(images):
    assert along_x(hold(images)) == pytest.approx(expect(images), rel=1e-6)


def test_it_falls_with_the_noise():
    assert along_x(hold(noise=0.1e-3)) == pytest.approx(expect(noise=0.1e-3), rel=1e-6)
    assert along_x(hold(noise=0.1e-3)) < 0.55 * along_x(hold())


def test_an_offset_does_not_average_out():
    """It is forgotten over a minute, so that ten seconds tell hardly more of it than one image."""
    offset = 0.1e-3
    long = along_x(hold(300, offset=offset))
    assert long == pytest.approx(expect(noise=offset), rel=0.05)
    assert long > 5.0 * along_x(hold(300))


def test_what_hides_a_key_point_raises_it():
    whole, less = hold(), hold()
    less.seen[:, -1] = False
    assert along_x(less) > along_x(whole)


def test_the_prior_of_friction_is_all_that_is_known_of_a_traction_that_no_key_point_shows():
    bound = bound_forces(hold(30, friction=0.25, traction=3.0), EXACT)[-1, 2, 2]
    assert np.sqrt(bound) == pytest.approx(0.25 * 3.0, rel=1e-6)


def test_every_error_that_is_stated_raises_it():
    least = along_x(hold(30))
    for name in ("floor", "shape", "relative", "camera", "camera_turn", "drift"):
        assert along_x(hold(30), replace(EXACT, **{name: getattr(Stated(), name)})) >= least
    assert along_x(hold(30), replace(EXACT, relative=Stated().relative)) > least
