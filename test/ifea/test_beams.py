"""Claims about one co-rotational beam and a cantilever of them."""

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ellipeinc, ellipk, ellipkinc

from finforce_ifea.fem.frame import Beams, add_beams
from finforce_ifea.fem.model import factorise_banded


def straight_beams(length, count, *, EA, EI, GA=np.inf):
    """A cantilever along z, clamped at z = 0, and its number of unknowns."""
    L = length / count
    shear = 1 + 12 * EI / (GA * L**2)
    z = np.linspace(0, length, count + 1)
    ends = np.stack([np.stack([0 * z[:-1], z[:-1]], 1), np.stack([0 * z[1:], z[1:]], 1)], axis=1)
    nodes = np.array([[3 * i, 3 * i + 1, 3 * i + 2, 3 * i + 2] for i in range(-1, count)])
    nodes[0] = 3 * count
    row = [EA / L, 4 * EI / L, 12 * EI / (L * shear), L / 3, L / (5 * shear**2)]
    beams = Beams(
        np.stack([nodes[:-1], nodes[1:]], axis=1),
        ends,
        np.zeros((count, 2, 2)),
        np.tile([0.0, 1.0], (count, 1)),
        np.full(count, L),
        np.tile(row, (count, 1)),
    )
    return beams, 3 * count


def evaluate_beams(beams, size, q, width=5):
    force, storage = np.zeros(size + 1), np.zeros((width + 1, size), order="F")
    energy, _ = add_beams(beams, q, force, storage)
    return energy, force[:-1], storage


def bend_cantilever(beams, size, load):
    """The equilibrium under a tip force [N] along +x, in twenty steps."""
    q, f = np.zeros(size), np.zeros(size)
    for share in np.linspace(0.05, 1, 20):
        f[-3] = share * load
        for _ in range(50):
            _, force, storage = evaluate_beams(beams, size, q)
            step = factorise_banded(storage).solve(f - force)
            q += step
            if np.abs(step).max() < 1e-12:
                break
    return q


def solve_elastica(alpha):
    """Tip deflection and drop over length, and tip angle, of a cantilever under P = alpha EI / L^2.

    Bisshopp, Drucker, Large deflection of cantilever beams, Q. Appl. Math. 3 (1945).
    """

    def modulus(angle):
        m = 0.5 * (1 + np.sin(angle))
        return m, np.arcsin(1 / np.sqrt(2 * m))

    def excess(angle):
        m, first = modulus(angle)
        return ellipk(m) - ellipkinc(first, m) - np.sqrt(alpha)

    angle = brentq(excess, 1e-9, np.pi / 2 - 1e-9)
    m, first = modulus(angle)
    deflection = 1 - 2 / np.sqrt(alpha) * (ellipeinc(np.pi / 2, m) - ellipeinc(first, m))
    return deflection, 1 - np.sqrt(2 * np.sin(angle) / alpha), angle


def test_rigid_motion_gives_no_force():
    joints = np.array([[0.001, 0.002], [0.004, 0.0]])
    arms = np.array([[0.0005, 0.0], [0.0, -0.001]])
    ends = joints + arms
    along = ends[1] - ends[0]
    length = np.linalg.norm(along)
    beams = Beams(
        np.array([[[0, 1, 2, 3], [4, 5, 6, 6]]]),
        ends[None],
        arms[None],
        along[None] / length,
        np.array([length]),
        np.array([[1e6, 3.0, 9.0, length / 3, length / 5]]),
    )
    for angle in (-3.0, 0.4, 2.0, 7.0):
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        moved = joints @ turn.T + [0.01, -0.02] - joints
        q = np.array([*moved[0], angle, angle, *moved[1], angle])
        energy, force, _ = evaluate_beams(beams, 7, q, width=6)
        assert energy < 1e-20
        # rounding of 1e-17 m times k_n
        assert np.abs(force).max() < 1e-9
    q[6] += 0.1
    assert np.abs(evaluate_beams(beams, 7, q, width=6)[1]).max() > 0.1


def test_stretch_falls_to_zero_as_an_end_stands_upright():
    beams, size = straight_beams(0.01, 1, EA=1e5, EI=1e-3)
    for angle, stretch in ((0.0, 1.0), (1.0, np.cos(1.0)), (0.5 * np.pi, 0.0), (2.0, np.cos(2.0))):
        force, storage = np.zeros(size + 1), np.zeros((6, size), order="F")
        _, smallest = add_beams(beams, np.array([0.0, 0.0, angle]), force, storage)
        assert smallest == pytest.approx(stretch, abs=1e-12)


def test_force_along_x_turns_z_towards_x():
    q = bend_cantilever(*straight_beams(0.05, 4, EA=1e5, EI=1e-3), 0.01)
    assert q[-3] > 0
    assert q[-1] > 0


def test_tip_deflection_is_that_of_beam_theory():
    L, EI, GA, P = 0.05, 1e-3, 20.0, 1e-3
    q = bend_cantilever(*straight_beams(L, 3, EA=1e5, EI=EI, GA=GA), P)
    # deflections of 0.1 % of the length: geometry adds less than 1e-5 of them
    assert q[-3] == pytest.approx(P * L**3 / (3 * EI) + P * L / GA, rel=1e-5)
    assert q[-1] == pytest.approx(P * L**2 / (2 * EI), rel=1e-5)


@pytest.mark.parametrize("alpha", [1, 2, 3, 4, 5, 6, 7, 8, 9, 10])
def test_large_deflection_is_that_of_the_elastica(alpha):
    L, EI = 0.05, 1e-3
    q = bend_cantilever(*straight_beams(L, 20, EA=1e6, EI=EI), alpha * EI / L**2)
    deflection, drop, angle = solve_elastica(alpha)
    np.testing.assert_allclose([q[-3] / L, -q[-2] / L, q[-1]], [deflection, drop, angle], rtol=2e-4)


def test_elastica_is_that_of_the_published_table():
    # Bisshopp and Drucker; Mattiasson 1981
    for alpha, deflection, drop in ((1, 0.30172, 0.05643), (5, 0.71379, 0.38763), (10, 0.81061, 0.55500)):
        np.testing.assert_allclose(solve_elastica(alpha)[:2], (deflection, drop), atol=1e-5)


def test_refinement_converges():
    L, EI, alpha = 0.05, 1e-3, 5.0
    exact = solve_elastica(alpha)[0]
    errors = [
        abs(bend_cantilever(*straight_beams(L, n, EA=1e7, EI=EI), alpha * EI / L**2)[-3] / L - exact)
        for n in (3, 6, 12)
    ]
    # at least second order, and three elements are good for 1 %
    assert errors[0] < 0.01
    assert errors[1] < errors[0] / 4
    assert errors[2] < errors[1] / 4
