"""Claims about the shapes of a finger: they hold what its mechanics do, and nothing that single points make up."""

import numpy as np
import pytest

from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.mechanics import build_mechanics
from finforce_ifea.settings import EstimatorSettings
from finforce_keypoints.detectors.side_plane import find_rest
from finforce_keypoints.geometry.template import (
    COUNT,
    find_motions,
    find_shape,
    fit_grid,
    fit_motion,
    span_shapes,
    trust,
)

NAMES = ("bench", "xlerobot", "ssg48_fin_ray_1")
RNG = np.random.default_rng(5)


def shapes_of(name):
    jaw = load_jaw(name)
    grid = fit_grid(find_shape(jaw))
    return span_shapes(find_motions(jaw), grid.pixels(find_rest(jaw)), grid.scale), grid


def press(name, height, force):
    """The motion of key points and reference point [px] under a force [N] on the face, the full nonlinear jaw."""
    jaw = load_jaw(name)
    mechanics = build_mechanics(jaw, EstimatorSettings(solver=jaw.model, mesh="coarse"))
    model, surface = mechanics.model, mechanics.contact.surface
    row = int(np.abs(surface.heights - height * surface.heights.max()).argmin())
    forces = np.zeros_like(surface.points)
    forces[row * surface.across : (row + 1) * surface.across, 0] = -1.0 / surface.across
    q, probe = np.zeros(model.size), model.attach(jaw.keypoints, 3e-3)
    for share in np.linspace(0.1, 1.0, 10):
        for _ in range(8):
            state = model.linearize(q)
            missing = model.load(surface.probe, q, share * force * forces) - state.force
            q = q + model.factorise(state.tangent).solve(missing)
    moved = (model.positions(probe, q) - jaw.keypoints)[:, [0, 2]]
    return np.vstack((moved, np.zeros((1, 2)))) / shapes_of(name)[1].scale


def fit(shapes, moves, stddev=1.0, weight=1.0):
    ones = np.ones(len(moves))
    return fit_motion(shapes, moves, stddev * ones, weight * ones)


@pytest.mark.parametrize("name", NAMES)
def test_both_sides_of_a_finger_move_alike(name):
    motions = find_motions(load_jaw(name))
    assert motions.shape == (COUNT, len(load_jaw(name).keypoints), 2) and np.isfinite(motions).all()
    np.testing.assert_array_equal(find_motions(load_jaw(name, "right")), motions)


@pytest.mark.parametrize(("height", "force", "least"), [(0.35, 6.0, 25.0), (0.6, 15.0, 55.0), (0.85, 6.0, 25.0)])
def test_a_finger_pressed_far_is_one_of_its_shapes(height, force, least):
    shapes, _ = shapes_of("bench")
    moved = press("bench", height, force)
    assert np.abs(moved).max() > least
    assert np.abs(fit(shapes, moved) - moved).max() < 0.04 * np.abs(moved).max()


@pytest.mark.parametrize("name", NAMES)
def test_points_on_the_wrong_rib_do_not_bend_the_shape(name):
    shapes, _ = shapes_of(name)
    moved = fit(shapes, 8.0 * RNG.standard_normal((shapes.shape[0] // 2, 2)))
    wrong = moved + RNG.normal(0.0, 0.5, moved.shape)
    which = np.arange(1, len(moved), 5)
    wrong[which] += (2.0, 9.0)
    found = fit(shapes, wrong)
    assert np.abs(found - moved)[which].max() < 3.0
    factors = trust(wrong, found)
    assert factors[which].max() < 0.5 < 0.8 < np.delete(factors, which).min()


def test_what_nobody_saw_follows_from_the_rest():
    shapes, _ = shapes_of("bench")
    moved = press("bench", 0.6, 6.0)
    seen = moved.copy()
    seen[::2] = np.nan
    assert np.abs(fit(shapes, seen) - moved).max() < 0.2 * np.abs(moved).max()
    assert np.abs(fit(shapes, np.full_like(moved, np.nan))).max() < 1e-12
    away = fit(shapes, moved + 50.0, weight=0.0)
    assert np.abs(away).max() < 1e-12


def test_a_finger_that_stands_elsewhere_is_no_bent_one():
    shapes, _ = shapes_of("bench")
    shifted = np.full((shapes.shape[0] // 2, 2), 3.0)
    assert np.abs(fit(shapes, shifted) - shifted).max() < 0.5
