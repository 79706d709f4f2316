"""The mechanics beside an independent finite element program: nine cylinders pressed on the bench finger.

lab/data/pressed_bench.npz holds key points [mm] and forces [N] of CalculiX 2.20 (20-node hexahedra, large displacement,
frictionless contact, St. Venant-Kirchhoff, E = 30 MPa, nu = 0.45) at depths of 1 to 10 mm, for cylinders of 15, 25 and
35 mm at heights of 20, 40 and 60 mm. The bounds are what was measured, rounded up.
"""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from mechanics_fakes import BENCH, HEIGHTS, bench_mechanics, bench_press

TRUTH = np.load(Path(__file__).parents[2] / "lab" / "data" / "pressed_bench.npz")
CASES = [(diameter, place) for diameter in (15, 25, 35) for place in HEIGHTS]
DEPTHS = tuple(range(1, 11))
# Largest error of the force's magnitude [%] over all depths.
FORCE = {
    ("default", "solid"): {"lower": 2.7, "middle": 2.6, "upper": 3.7},
    ("coarse", "solid"): {"lower": 31.0, "middle": 17.0, "upper": 7.2},
    ("default", "frame"): {"lower": 3.8, "middle": 1.0, "upper": 1.9},
}
# Largest error of a key point [mm] up to 5 mm and up to 10 mm.
KEYPOINTS = {
    ("default", "solid"): {"lower": (0.11, 0.41), "middle": (0.05, 0.11), "upper": (0.05, 0.07)},
    ("coarse", "solid"): {"lower": (0.16, 0.66), "middle": (0.07, 0.22), "upper": (0.07, 0.17)},
    ("default", "frame"): {"lower": (0.12, 0.36), "middle": (0.07, 0.13), "upper": (0.06, 0.11)},
}


def test_truth_is_of_this_finger():
    np.testing.assert_allclose(1e-3 * TRUTH["keypoints0"], BENCH.keypoints, atol=1e-5)


@cache
def compare(mesh, solver, diameter, place, every=1):
    """Errors of the force's magnitude [%] and direction [deg], and of each key point [mm], by depth."""
    results = bench_press(mesh, solver, diameter, round(1e3 * HEIGHTS[place]), DEPTHS[::every])
    true = TRUTH[f"{diameter}_{place}_force"][::every]
    np.testing.assert_allclose(TRUTH[f"{diameter}_{place}_depth"], DEPTHS)
    force = np.array([result.force for result in results])
    magnitude = np.linalg.norm(force, axis=1) / np.linalg.norm(true, axis=1) - 1.0
    lean = [np.degrees(np.arctan2(part[:, 2], -part[:, 0])) for part in (force, true)]
    model = bench_mechanics(mesh, solver).model
    probe = model.attach(BENCH.keypoints, 1e-3)
    points = [model.positions(probe, result.q) for result in results]
    moved = 1e3 * (np.array(points) - model.positions(probe, np.zeros(model.size)))
    true_moved = TRUTH[f"{diameter}_{place}_keypoints"][::every] - TRUTH["keypoints0"]
    return 100 * magnitude, lean[0] - lean[1], np.linalg.norm(moved - true_moved, axis=2)


@pytest.mark.parametrize(("diameter", "place"), CASES)
@pytest.mark.parametrize(("mesh", "solver"), FORCE)
def test_force_is_that_of_the_independent_program(mesh, solver, diameter, place):
    """Solid, default mesh: within 2.7 % but for the upper height (15 mm 3.7 %, 25 mm 3.5 %, 35 mm 3.3 %)."""
    error, _, _ = compare(mesh, solver, diameter, place)
    assert np.abs(error).max() < FORCE[mesh, solver][place]


def test_default_mesh_meets_the_force_within_3_percent_in_most_states():
    errors = np.concatenate([compare("default", "solid", *case)[0] for case in CASES])
    assert np.mean(np.abs(errors) < 3.0) > 0.8
    assert np.sqrt(np.mean(errors**2)) < 2.2


@pytest.mark.parametrize(("diameter", "place"), [(15, "upper"), (35, "middle"), (35, "lower")])
def test_refined_mesh_meets_the_force_within_3_percent(diameter, place):
    error, _, moved = compare("fine", "solid", diameter, place, every=3)
    assert np.abs(error).max() < 3.0
    assert moved.max() < (0.32 if place == "lower" else 0.10)


@pytest.mark.parametrize(("diameter", "place"), CASES)
@pytest.mark.parametrize(("mesh", "solver"), KEYPOINTS)
def test_key_points_are_those_of_the_independent_program(mesh, solver, diameter, place):
    """Solid, default mesh: within 0.11 mm at the middle and above, and below up to 5 mm; there 0.41 mm at 10 mm."""
    _, _, moved = compare(mesh, solver, diameter, place)
    shallow, deep = KEYPOINTS[mesh, solver][place]
    assert moved[:5].max() < shallow
    assert moved.max() < deep


@pytest.mark.parametrize(("diameter", "place"), CASES)
def test_direction_of_the_force_is_that_of_the_independent_program(diameter, place):
    """Within 1.3 degrees."""
    _, lean, _ = compare("default", "solid", diameter, place)
    assert np.abs(lean).max() < 1.3


def test_small_deflection_theory_misses_a_third_of_the_force():
    """The opposite case: a stiffness that does not follow the finger misses the force at 10 mm by far."""
    small = bench_press("default", "solid", 35, 20, DEPTHS)[0].force
    true = np.linalg.norm(TRUTH["35_lower_force"][-1])
    assert 10 * np.linalg.norm(small) < 0.7 * true
