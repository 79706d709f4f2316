"""Claims about the inverse problem with given contacts."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from mechanics_fakes import BENCH, bench_mechanics

from finforce_ifea.errors import ContactError, NotEnoughDataError, UnobservableError
from finforce_ifea.paper_inverse import Problem, scale_energy, solve_inverse, surface_normals

FACE = BENCH.inner_face_x
MODELS = {"solid": ("coarse", "solid"), "frame": ("default", "frame"), "whole": ("coarse", "solid", "three")}


SIDES = (-0.00577, 0.00577)
MIDDLE = (0.0,)


def line(heights, sides):
    """Points across the width at some heights [m], those of one height together."""
    return np.array([[FACE, y, z] for z in heights for y in sides])


@dataclass(frozen=True, kw_only=True)
class Loaded:
    """A finger in equilibrium with known forces (n, 3) [N] at contacts."""

    model: object
    problem: Problem
    forces: np.ndarray
    q: np.ndarray


def load_finger(name, heights, forces_of, *, sides=SIDES, **options):
    """Finds the equilibrium under forces_of(outward normals) by Newton's method, without the inverse solver."""
    model = bench_mechanics(*MODELS[name]).model
    points = line(heights, sides)
    neighbours = np.repeat(points, 2, axis=0)
    neighbours[::2, 2] -= 1e-3
    neighbours[1::2, 2] += 1e-3
    probes = [model.attach(p, 1e-3) for p in (points, neighbours, BENCH.keypoints)]
    q = np.zeros(model.size)
    for share in np.r_[np.linspace(0.2, 1.0, 5), np.ones(60)]:
        forces = share * forces_of(surface_normals(model, probes[1], q))
        state = model.linearize(q)
        step = model.factorise(state.tangent).solve(model.load(probes[0], q, forces) - state.force)
        q = q + step
        if share == 1.0 and np.abs(step).max() < 1e-13:
            break
    assert np.abs(step).max() < 1e-12
    targets = model.positions(probes[2], q)
    problem = Problem(effectors=probes[2], targets=targets, contacts=probes[0], neighbours=probes[1], **options)
    return Loaded(model=model, problem=problem, forces=forces, q=q)


def recover(loaded, **changes):
    return solve_inverse(loaded.model, replace(loaded.problem, **changes), np.zeros(loaded.model.size), iterations=40)


def equal_weights(count):
    return np.full(2 * count, 0.5)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("height", [BENCH.candidates[6, 2], 0.0412, 0.020, 0.0655])
def test_known_force_is_recovered_at_a_candidate_and_between_candidates(name, height):
    """From the deformed shape of the model itself, up to some 10 mm of deflection: to rounding."""
    loaded = load_finger(name, [height], lambda normals: -0.5 * 2.5 * normals, weights=equal_weights(1))
    assert np.abs(loaded.problem.targets - BENCH.keypoints).max() > 2e-3
    result = recover(loaded)
    np.testing.assert_allclose(result.forces, loaded.forces, atol=1e-6)
    assert result.converged
    assert result.residual < 1e-9
    assert result.kkt < 1e-8
    np.testing.assert_allclose(result.q, loaded.q, atol=1e-9)


def test_force_is_normal_to_the_deformed_surface():
    loaded = load_finger("solid", [0.020], lambda normals: -0.5 * 3.0 * normals, weights=equal_weights(1))
    force = recover(loaded).forces.sum(0)
    lean = np.degrees(np.arctan2(force[2], -force[0]))
    assert np.linalg.norm(force) == pytest.approx(3.0, abs=1e-6)
    assert abs(lean) > 5.0


def test_shared_force_is_recovered_with_its_weights():
    shares = np.array([0.7, 0.7, 0.3, 0.3]) / 2
    loaded = load_finger("solid", [0.030, 0.045], lambda n: -2.0 * shares[:, None] * n, weights=equal_weights(2))
    right = recover(loaded, weights=shares)
    wrong = recover(loaded)
    np.testing.assert_allclose(right.forces, loaded.forces, atol=1e-7)
    assert right.residual < 1e-9 < 1e-5 < wrong.residual


def test_several_forces_are_told_apart():
    sizes = np.array([0.4, 0.4, 0.7, 0.7])
    loaded = load_finger("whole", [0.025, 0.060], lambda normals: -sizes[:, None] * normals)
    np.testing.assert_allclose(recover(loaded).forces, loaded.forces, atol=2e-5)


def test_forces_at_all_candidates_are_told_apart_when_there_is_no_noise():
    sizes = np.array([0.1] * 6 + [0.3] + [0.1] * 7)
    loaded = load_finger("solid", BENCH.candidates[:, 2], lambda n: -sizes[:, None] * n, sides=MIDDLE)
    result = recover(loaded)
    # the program's condition is 1e10: rounding comes back as some per cent of single forces, hardly of their sum
    np.testing.assert_allclose(result.forces, loaded.forces, atol=0.01)
    np.testing.assert_allclose(result.forces.sum(0), loaded.forces.sum(0), atol=1e-4)


def test_force_in_three_axes_is_recovered():
    force = np.array([-1.2, 0.3, -0.5])
    loaded = load_finger("whole", [0.040], lambda _: force[None], sides=MIDDLE, weights=np.ones(1), axes="three")
    result = recover(loaded)
    np.testing.assert_allclose(result.forces.sum(0), force, atol=1e-7)
    assert result.converged and result.residual < 1e-10


def test_hidden_key_points_do_not_count():
    loaded = load_finger("solid", [0.040], lambda normals: -0.5 * 2.0 * normals, weights=equal_weights(1))
    targets = loaded.problem.targets.copy()
    targets[[0, 3, 7, 14]] = np.nan
    np.testing.assert_allclose(recover(loaded, targets=targets).forces, loaded.forces, atol=1e-7)
    targets[1:, 1] = np.nan
    targets[2] = loaded.problem.targets[2]
    # one key point is enough for one force
    np.testing.assert_allclose(recover(loaded, targets=targets).forces, loaded.forces, atol=1e-7)


def test_precision_decides_whom_to_believe():
    loaded = load_finger("solid", [0.040], lambda normals: -0.5 * 2.0 * normals, weights=equal_weights(1))
    targets = loaded.problem.targets.copy()
    targets[3] += [2e-3, 0, 0]
    precision = np.ones(15)
    moved = recover(loaded, targets=targets).forces
    precision[3] = 1e-9
    kept = recover(loaded, targets=targets, precision=precision).forces
    assert np.abs(moved - loaded.forces).max() > 0.02
    np.testing.assert_allclose(kept, loaded.forces, atol=1e-7)


@pytest.mark.parametrize("name", ["solid", "frame"])
def test_contact_never_pulls(name):
    """Key points moved out of the jaw would need a pulling force: it is exactly zero."""
    loaded = load_finger(name, [0.040], lambda normals: -0.5 * 1.0 * normals, weights=equal_weights(1))
    outward = BENCH.keypoints + (BENCH.keypoints - loaded.problem.targets)
    result = recover(loaded, targets=outward)
    assert not result.forces.any()
    assert result.kkt < 1e-8
    assert np.abs(result.q).max() < 1e-12


@pytest.mark.parametrize("sign", [-1, 1])
def test_tangential_forces_may_have_either_sign_in_three_axes(sign):
    force = np.array([-1.0, 0.0, 0.4 * sign])
    loaded = load_finger("whole", [0.050], lambda _: force[None], sides=MIDDLE, weights=np.ones(1), axes="three")
    np.testing.assert_allclose(recover(loaded).forces.sum(0), force, atol=1e-7)


def test_start_does_not_matter():
    loaded = load_finger("solid", [0.040], lambda normals: -0.5 * 2.0 * normals, weights=equal_weights(1))
    other = load_finger("solid", [0.060], lambda normals: -0.5 * 1.0 * normals, weights=equal_weights(1))
    warm = solve_inverse(loaded.model, loaded.problem, other.q, iterations=40)
    np.testing.assert_allclose(warm.forces, loaded.forces, atol=1e-7)


def test_state_is_in_equilibrium_with_the_force():
    loaded = load_finger("solid", [0.040], lambda normals: -0.5 * 2.0 * normals, weights=equal_weights(1))
    targets = loaded.problem.targets + 3e-4 * np.random.default_rng(0).normal(size=(15, 3))
    result = recover(loaded, targets=targets)
    left = loaded.model.linearize(result.q).force - loaded.model.load(loaded.problem.contacts, result.q, result.forces)
    assert np.abs(left).max() < 1e-6
    assert result.residual == pytest.approx(
        np.sqrt(((loaded.model.positions(loaded.problem.effectors, result.q) - targets) ** 2).sum(1).mean())
    )


def test_unfinished_iteration_says_so():
    loaded = load_finger("solid", [0.020], lambda normals: -0.5 * 3.0 * normals, weights=equal_weights(1))
    result = solve_inverse(loaded.model, loaded.problem, np.zeros(loaded.model.size), iterations=2)
    assert not result.converged
    assert result.iterations == 2


# --- the energy weight


def small_load(size=1e-3):
    return load_finger("solid", [0.040], lambda normals: -0.5 * size * normals, weights=equal_weights(1))


@pytest.mark.parametrize("epsilon", [1e-3, 1e-1, 1.0])
def test_scaled_energy_takes_a_share_eps_of_a_force_along_one_axis(epsilon):
    """SOFA's form: the force is F / (1 + eps), biased by eps / (1 + eps)."""
    loaded = small_load()
    found = recover(loaded, energy_weight=epsilon, energy_form="sofa").forces
    # 1e-4: the geometry is nonlinear even at a millinewton
    np.testing.assert_allclose(found[:, 0], loaded.forces[:, 0] / (1 + epsilon), rtol=1e-4)


@pytest.mark.parametrize("epsilon", [1e-3, 1e-1])
def test_printed_energy_biases_by_compliances(epsilon):
    """The paper's form: F W_ea' W_ea / (W_ea' W_ea + eps W_aa), which depends on units and on the place."""
    loaded = small_load()
    model, problem = loaded.model, loaded.problem
    pushes = model.load(problem.contacts, loaded.q, loaded.forces / 1e-3)
    mode = model.factorise(model.linearize(loaded.q).tangent).solve(pushes)
    W_ea, W_aa = model.project(problem.effectors, loaded.q, mode[:, None]).ravel(), pushes @ mode
    expected = W_ea @ W_ea / (W_ea @ W_ea + epsilon * W_aa)
    found = recover(loaded, energy_weight=epsilon, energy_form="paper").forces
    np.testing.assert_allclose(found[:, 0], loaded.forces[:, 0] * expected, rtol=1e-4)


@pytest.mark.parametrize("form", ["paper", "sofa"])
def test_force_falls_with_the_energy_weight_and_both_forms_meet_at_zero(form):
    loaded = load_finger("solid", [0.040], lambda normals: -0.5 * 2.0 * normals, weights=equal_weights(1))
    sizes = [
        np.linalg.norm(recover(loaded, energy_weight=eps, energy_form=form).forces.sum(0))
        for eps in (0, 1e-9, 1e-4, 1e-2)
    ]
    assert sizes[0] == pytest.approx(2.0, abs=1e-6)
    # 1e-9 W_aa of 3e-3 m/N beside W_ea' W_ea of 1e-5 m^2/N^2
    assert sizes[1] == pytest.approx(2.0, abs=1e-5)
    assert sizes[1] > sizes[2] > sizes[3]


def test_energy_scales():
    random = np.random.default_rng(0)
    A, B = random.normal(size=(2, 5, 3))
    Q, W = A.T @ A, B.T @ B
    np.testing.assert_array_equal(scale_energy(Q, W, "paper"), W)
    scaled = scale_energy(Q, W, "sofa")
    assert np.linalg.norm(scaled, np.inf) == pytest.approx(np.linalg.norm(Q, np.inf))
    np.testing.assert_allclose(scaled / scaled[0, 0], W / W[0, 0])
    np.testing.assert_allclose(scale_energy(1e6 * Q, W, "sofa"), 1e6 * scaled)


def test_covariance_is_that_of_the_least_squares_problem():
    """Scatter of the force under seeded noise of 0.1 mm per axis, over 60 draws, beside what is announced."""
    loaded = load_finger("frame", [0.040], lambda normals: -0.5 * 1.0 * normals, weights=equal_weights(1))
    random, precision = np.random.default_rng(0), np.full(15, 1.0 / 0.1e-3**2)
    sizes = []
    for _ in range(60):
        targets = loaded.problem.targets + 0.1e-3 * random.normal(size=(15, 3))
        result = solve_inverse(loaded.model, replace(loaded.problem, targets=targets, precision=precision), loaded.q)
        sizes.append(np.linalg.norm(result.forces.sum(0)))
    announced = np.sqrt(result.covariance[0, 0])
    # 60 draws tell a standard deviation within 10 %; three of them
    assert np.std(sizes) == pytest.approx(announced, rel=0.3)


# --- what cannot be solved


def test_no_active_key_point_is_not_enough():
    loaded = small_load()
    with pytest.raises(NotEnoughDataError, match="no key point"):
        recover(loaded, targets=np.full((15, 3), np.nan))


def test_key_point_that_no_force_moves_tells_nothing():
    loaded = small_load()
    base = loaded.model.attach(np.array([[0.0132, 0.01, 0.0]]), 1e-3)
    with pytest.raises(UnobservableError, match="moves no active key point"):
        recover(loaded, effectors=base, targets=np.array([[0.0132, 0.01, 0.0]]))


def test_two_forces_at_one_place_cannot_be_told_apart():
    loaded = load_finger("solid", [0.040, 0.040], lambda normals: -0.3 * normals)
    with pytest.raises(UnobservableError, match="distinguish the forces"):
        recover(loaded)


def test_problem_without_contact_is_refused():
    loaded = small_load()
    with pytest.raises(ContactError):
        recover(loaded, contacts=None)


# --- normals


def test_normals_point_out_of_the_inner_surface():
    loaded = load_finger("solid", [0.020], lambda normals: -0.5 * 3.0 * normals, weights=equal_weights(1))
    rest = surface_normals(loaded.model, loaded.problem.neighbours, np.zeros(loaded.model.size))
    np.testing.assert_allclose(rest, np.tile([1.0, 0.0, 0.0], (2, 1)), atol=1e-12)
    bent = surface_normals(loaded.model, loaded.problem.neighbours, loaded.q)
    np.testing.assert_allclose(np.linalg.norm(bent, axis=1), 1.0)
    points = loaded.model.positions(loaded.problem.neighbours, loaded.q)
    assert np.abs(((points[1::2] - points[::2]) * [1, 0, 1] * bent).sum(1)).max() < 1e-12
