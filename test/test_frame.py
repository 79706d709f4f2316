"""Claims about the planar frame."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ellipeinc, ellipk, ellipkinc

from finforce_ifea import frame as frame_module
from finforce_ifea.beams import Beams, add_beams
from finforce_ifea.errors import MeshError
from finforce_ifea.factor import BandedFactor, SparseFactor, factorise_banded, sparse_from_banded
from finforce_ifea.frame import FrameDivisions, FrameModel
from finforce_ifea.jaw import load_jaw
from finforce_ifea.jaw_parts import Material

BENCH, STEEL = load_jaw("bench"), load_jaw("steel")
TPU = Material(young_modulus=30e6, poisson_ratio=0.45)
PENALTY = 1.5e5  # N/m per contact point, one every 0.5 mm
# Independent finite elements (CalculiX, 20-node hexahedra, E = 30 MPa, nu = 0.45): the force's magnitude [N]
# of a cylinder pressed 5 and 10 mm into the bench finger; by radius and height [m].
TRUE_FORCES = {
    (0.0075, 0.020): (3.528, 6.675),
    (0.0075, 0.040): (1.654, 3.410),
    (0.0075, 0.060): (1.944, 4.189),
    (0.0125, 0.020): (3.800, 7.824),
    (0.0125, 0.040): (1.654, 3.409),
    (0.0125, 0.060): (1.947, 4.218),
    (0.0175, 0.020): (4.146, 11.723),
    (0.0175, 0.040): (1.654, 3.415),
    (0.0175, 0.060): (1.959, 4.242),
}
# Its key points' motion (x, z) [mm] at 10 mm, radius 12.5 mm, height 40 mm.
TRUE_MOTION = [
    *[[-1.44, -0.11], [-4.48, -0.57], [-7.54, -1.04], [-9.70, -1.28], [-9.65, -1.29]],
    *[[-8.03, -1.43], [-5.96, -1.66], [-1.17, 0.20], [-4.02, 0.59], [-7.03, 0.97]],
    *[[-9.24, 1.33], [-9.34, 1.33], [-7.79, 0.71], [-5.78, -0.14], [-2.71, -1.75]],
]
# The measured steel finger: base displacements [m] and the sensor's magnitudes [N].
MEASURED = {0.005: 1.494, 0.010: 2.946, 0.015: 4.670, 0.020: 6.555, 0.025: 9.417, 0.030: 13.624}


@pytest.fixture(scope="module")
def bench():
    return FrameModel(BENCH.drawing, TPU, mesh=BENCH.build_mesh("coarse"))


@pytest.fixture(scope="module")
def steel():
    return FrameModel(STEEL.drawing, STEEL.material)


@pytest.fixture(scope="module")
def pressed(bench):
    return Press(bench, BENCH, 0.0125, 0.035).to(0.008)


@pytest.fixture(scope="module")
def pressed_steel(steel):
    return Press(steel, STEEL, 0.020, 0.065).to(0.020)


class Press:
    """A rigid cylinder pressed into the inner face by a penalty, step by step."""

    def __init__(self, model, jaw, radius, height):
        self.model, self.radius, self.height, self.face = model, radius, height, jaw.inner_face_x
        z = np.arange(0.5e-3, jaw.drawing.length - 0.4e-3, 0.5e-3)
        self.probe = model.attach(np.stack([np.full_like(z, self.face), 0 * z, z], axis=1), 1e-3)
        self.q, self.depth, self.force = np.zeros(model.size), 0.0, np.zeros(3)

    def to(self, depth, step=1e-3):
        for current in np.linspace(self.depth, depth, int(np.ceil((depth - self.depth) / step)) + 1)[1:]:
            self._settle(np.array([self.face + self.radius - current, 0.0, self.height]))
        self.depth = depth
        return self

    def _settle(self, axis):
        model = self.model
        for _ in range(100):
            away = model.positions(self.probe, self.q) - axis
            distance = np.linalg.norm(away, axis=1)
            normal, inside = away / distance[:, None], np.maximum(self.radius - distance, 0.0)
            forces, across = PENALTY * inside[:, None] * normal, normal[:, [2, 1, 0]] * [1, 0, -1]
            springs = np.einsum("pi,pj->pij", normal, normal) * (PENALTY * (inside > 0))[:, None, None]
            springs -= np.einsum("pi,pj->pij", across, across) * (PENALTY * inside / distance)[:, None, None]
            state = model.linearize(self.q)
            model.stiffen(state.tangent, self.probe, self.q, springs)
            load = model.load(self.probe, self.q, forces) - state.force
            step = model.factorise(state.tangent).solve(load)
            largest = np.abs(np.where(model.rotations, 7e-3 * step, step)).max()
            self.q = self.q + step * min(1.0, 2e-3 / max(largest, 1e-12))
            if largest < 1e-8:
                self.force = forces.sum(axis=0)
                return
        raise AssertionError(f"no equilibrium at {axis}")


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
    energy, _ = add_beams(beams, q, True, force, storage)
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


def line_stiffness(model, height):
    """N/m of the unloaded finger under a force along -x on its inner face."""
    probe = model.attach(np.array([[model.drawing.inner_face_x, 0.0, height]]), 1e-3)
    q = np.zeros(model.size)
    load = model.load(probe, q, np.array([[-1.0, 0.0, 0.0]]))
    step = model.factorise(model.linearize(q).tangent).solve(load)
    return -1.0 / model.project(probe, q, step[:, None])[0, 0, 0]


# ---- one beam


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


# ---- the frame


@pytest.mark.parametrize("state", ["pressed", "pressed_steel"])
def test_tangent_is_the_derivative_of_the_force(state, request):
    press = request.getfixturevalue(state)
    model, q = press.model, press.q
    K = sparse_from_banded(model.linearize(q).tangent).toarray()
    h = 1e-7
    differences = np.empty_like(K)
    for j in range(model.size):
        step = h * np.eye(model.size)[j]
        up, down = (model.linearize(q + s * step, tangent=False).force for s in (1, -1))
        differences[:, j] = (up - down) / (2 * h)
    scale = np.sqrt(np.outer(np.diag(K), np.diag(K)))
    assert np.abs((differences - K) / scale).max() < 1e-6
    assert np.abs(K - K.T).max() == 0.0
    assert np.linalg.eigvalsh(K)[0] > 0


@pytest.mark.parametrize("state", ["pressed", "pressed_steel"])
def test_force_is_the_gradient_of_the_energy(state, request):
    press = request.getfixturevalue(state)
    model, q = press.model, press.q
    direction = 1e-7 * q / np.abs(q).max()
    up, down = (model.linearize(q + s * direction, tangent=False).energy for s in (1, -1))
    assert (up - down) / 2 == pytest.approx(model.linearize(q).force @ direction, rel=1e-6)


def test_unloaded_frame_is_at_rest(bench, steel):
    for model in (bench, steel):
        state = model.linearize(np.zeros(model.size))
        assert np.abs(state.force).max() < 1e-9
        assert state.smallest_det == pytest.approx(1.0)
        assert model.linearize(np.zeros(model.size), tangent=False).tangent is None


def test_tangent_is_narrow_and_definite(bench):
    # so narrow that a factorisation costs some 10 us
    assert bench.size < 300
    assert bench.bandwidth < 30
    assert isinstance(bench.factorise(bench.linearize(np.zeros(bench.size)).tangent), BandedFactor)


def test_unstable_state_is_still_solved(bench):
    tangent = bench.linearize(np.zeros(bench.size)).tangent
    tangent[0, 5] -= 2 * tangent[0, 5]
    factor, b = bench.factorise(tangent), np.linspace(-1, 1, bench.size)
    assert isinstance(factor, SparseFactor)
    np.testing.assert_allclose(sparse_from_banded(tangent) @ factor.solve(b), b, atol=1e-8)


# ---- material points


def test_undeformed_points_are_where_they_were(bench):
    points = np.concatenate([BENCH.keypoints, BENCH.candidates, BENCH.build_mesh("coarse").nodes])
    rest = np.zeros(bench.size)
    np.testing.assert_allclose(bench.positions(bench.attach(points), rest), points, atol=1e-15)
    np.testing.assert_allclose(bench.vertices(rest), BENCH.build_mesh("coarse").nodes, atol=1e-15)


def test_skin_of_the_steel_finger_moves_with_its_strips(pressed_steel):
    mesh = STEEL.build_mesh()
    model = FrameModel(STEEL.drawing, STEEL.material, mesh=mesh)
    np.testing.assert_allclose(model.vertices(np.zeros(model.size)), mesh.nodes, atol=1e-15)
    moved = model.vertices(pressed_steel.q)
    # the leaning strip's section is normal to it, the clamped one level: 0.05 mm apart
    assert np.abs(moved[mesh.clamped] - mesh.nodes[mesh.clamped]).max() < 1e-7
    # the strips keep their thickness: neighbouring nodes on both faces stay 0.2 mm apart
    row = np.flatnonzero(np.isclose(mesh.nodes[:, 0], STEEL.inner_face_x, atol=1e-7))
    back = np.flatnonzero(np.isclose(mesh.nodes[:, 0], STEEL.inner_face_x - 0.2e-3, atol=1e-7))
    gap = np.linalg.norm(moved[row][:, None] - moved[back], axis=2).min(axis=1)
    np.testing.assert_allclose(gap, 0.2e-3, rtol=1e-3)


@pytest.mark.parametrize("state", ["pressed", "pressed_steel"])
def test_motion_is_the_derivative_of_the_position(state, request):
    press = request.getfixturevalue(state)
    model, q = press.model, press.q
    jaw = BENCH if state == "pressed" else STEEL
    probe = model.attach(np.concatenate([jaw.keypoints, jaw.candidates, jaw.build_mesh().nodes[::7]]), 1e-3)
    modes = np.eye(model.size)
    motion = model.project(probe, q, modes)
    h = 1e-7
    for j in range(model.size):
        up, down = (model.positions(probe, q + s * h * modes[j]) for s in (1, -1))
        np.testing.assert_allclose(motion[:, :, j], (up - down) / (2 * h), atol=1e-8)
    assert np.abs(motion[:, 1]).max() == 0.0


def test_load_is_the_transpose_of_project(bench, pressed):
    probe = bench.attach(BENCH.build_mesh("coarse").nodes)
    rng = np.random.default_rng(1)
    forces, mode = rng.standard_normal((len(probe.points), 3)), rng.standard_normal((bench.size, 1))
    work = np.sum(forces * bench.project(probe, pressed.q, mode)[:, :, 0])
    assert bench.load(probe, pressed.q, forces) @ mode[:, 0] == pytest.approx(work, rel=1e-12)


def test_springs_are_those_of_the_points(bench, pressed):
    probe = bench.attach(BENCH.build_mesh("coarse").nodes[::5])
    rng = np.random.default_rng(2)
    roots = rng.standard_normal((len(probe.points), 3, 3))
    blocks, modes = roots @ roots.transpose(0, 2, 1), np.eye(bench.size)
    tangent = np.zeros((bench.bandwidth + 1, bench.size), order="F")
    bench.stiffen(tangent, probe, pressed.q, blocks)
    motion = bench.project(probe, pressed.q, modes)
    expected = np.einsum("pai,pab,pbj->ij", motion, blocks, motion)
    np.testing.assert_allclose(sparse_from_banded(tangent).toarray(), expected, atol=1e-10 * expected.max())


def test_points_run_smoothly_along_the_inner_face(bench, pressed):
    joints = bench.beams.ends[bench.beams.ends[:, 1, 0] == BENCH.drawing.inner.centre_x(0.0), 1, 1]
    h = 1e-6
    for x, relative in ((BENCH.drawing.inner.centre_x(0.0), 1e-3), (BENCH.inner_face_x, None)):
        for z in joints:
            line = np.array([[x, 0.0, z + s * h] for s in (-2, -1, 1, 2)])
            places = bench.positions(bench.attach(line), pressed.q)
            before, after = (places[1] - places[0]) / h, (places[3] - places[2]) / h
            if relative:
                # 3 um of the sharpest curvature, 60 / m, turn a tangent by 2e-4
                np.testing.assert_allclose(after, before, atol=relative)
            before, after = before / np.linalg.norm(before), after / np.linalg.norm(after)
            np.testing.assert_allclose(after, before, atol=1e-3)


def test_points_off_the_finger_are_refused_by_number(bench):
    points = np.array([[0.0132, 0.01, 0.009], [0.0, 0.0, 0.0325]])
    with pytest.raises(MeshError, match=r"point 1 at \[0.0, 0.0, 32.5\] mm is 2.54 mm away"):
        bench.attach(points, 1e-3)
    bench.attach(points, 5e-3)
    with pytest.raises(MeshError, match="point 0"):
        bench.attach(np.full((1, 3), np.nan), 1e-3)


def test_frame_without_a_mesh_has_no_vertices(steel):
    with pytest.raises(MeshError, match="without a mesh"):
        steel.vertices(np.zeros(steel.size))


# ---- joints


def test_rigid_hinged_bars_keep_their_length(pressed_steel):
    model = pressed_steel.model
    ends = model.attach(STEEL.keypoints)
    states = (np.zeros(model.size), pressed_steel.q)
    before, after = (model.positions(ends, q).reshape(2, 4, 3) for q in states)
    change = np.linalg.norm(after[0] - after[1], axis=1) - np.linalg.norm(before[0] - before[1], axis=1)
    assert np.abs(after - before).max() > 0.01
    assert np.abs(change).max() < 1e-6


def test_offset_joints_stiffen(monkeypatch, bench):
    monkeypatch.setattr(frame_module, "_OVERLAP", 0.0)
    monkeypatch.setattr(frame_module, "_ROOT", 1e3)
    lines = FrameModel(BENCH.drawing, TPU)
    for height in (0.020, 0.040, 0.060):
        ratio = line_stiffness(bench, height) / line_stiffness(lines, height)
        assert 1.05 < ratio < 1.5


def test_hinges_soften_and_rigid_ribs_stiffen(bench):
    drawing = BENCH.drawing
    hinged, welded, linked = (
        FrameModel(replace(drawing, joints=joints, bars=bars), TPU)
        for joints, bars in (("hinged", "elastic"), ("stiff", "rigid"), ("hinged", "rigid"))
    )
    for height in (0.0325, 0.0515):
        stiffness = [line_stiffness(model, height) for model in (hinged, bench, welded)]
        assert stiffness == sorted(stiffness)
        assert line_stiffness(linked, height) < line_stiffness(welded, height)


def test_welded_rigid_ribs_do_not_deform():
    drawing = replace(BENCH.drawing, joints="stiff", bars="rigid")
    press = Press(FrameModel(drawing, TPU), BENCH, 0.0125, 0.0420).to(0.003)
    rib = drawing.ribs[3]
    x = np.linspace(drawing.outer.centre_x(rib.outer_z), drawing.inner.centre_x(rib.inner_z), 5)
    line = np.stack([x, 0 * x, np.full_like(x, rib.inner_z)], axis=1)
    moved = press.model.positions(press.model.attach(line), press.q)
    assert np.abs(moved - line).max() > 1e-4
    apart, moved_apart = (np.linalg.norm(p[:, None] - p, axis=2) for p in (line, moved))
    np.testing.assert_allclose(moved_apart, apart, atol=1e-12)


def test_clamped_part_does_not_move():
    model = FrameModel(replace(BENCH.drawing, clamped_z=0.004), TPU)
    q = np.random.default_rng(3).uniform(-1e-3, 1e-3, model.size)
    points = np.array([[0.014, 0.0, 0.001], [0.0124, 0.01, 0.004], [-0.0137, 0.0, 0.0035]])
    np.testing.assert_allclose(model.positions(model.attach(points), q), points, atol=1e-15)
    assert line_stiffness(model, 0.020) > line_stiffness(FrameModel(BENCH.drawing, TPU), 0.020)


def test_finger_without_ribs_is_two_bands():
    model = FrameModel(replace(BENCH.drawing, ribs=()), TPU)
    assert 0 < line_stiffness(model, 0.04) < line_stiffness(FrameModel(BENCH.drawing, TPU), 0.04)


def test_divisions_below_one_are_refused():
    with pytest.raises(MeshError, match="along_rib=0"):
        FrameDivisions(along_rib=0)


# ---- against the independent finite elements and the measured finger


@pytest.mark.parametrize("place", TRUE_FORCES)
def test_force_is_that_of_independent_finite_elements(bench, place):
    press = Press(bench, BENCH, *place)
    forces = [np.linalg.norm(press.to(depth).force) for depth in (0.005, 0.010)]
    np.testing.assert_allclose(forces, TRUE_FORCES[place], rtol=0.03)


def test_key_points_are_those_of_independent_finite_elements(bench):
    press = Press(bench, BENCH, 0.0125, 0.040).to(0.010)
    moved = bench.positions(bench.attach(BENCH.keypoints), press.q) - BENCH.keypoints
    # the camera sees 0.2 mm; the largest motion is 9.8 mm
    np.testing.assert_allclose(1e3 * moved[:, [0, 2]], TRUE_MOTION, atol=0.15)


def test_finer_division_changes_the_force_by_less_than_a_percent(bench):
    fine = FrameModel(BENCH.drawing, TPU, divisions=FrameDivisions(between_ribs=10, along_rib=8))
    forces = [Press(model, BENCH, 0.0125, 0.060).to(0.010).force for model in (bench, fine)]
    np.testing.assert_allclose(forces[0], forces[1], atol=0.01 * np.linalg.norm(forces[1]))


def test_measured_force_comes_back_with_feet_on_the_bars():
    # 64.7 mm is where the pictures place the cylinder; the length of the hinges' feet is fitted to the forces
    ribs = tuple(replace(rib, thickness=6e-3) for rib in STEEL.drawing.ribs)
    feet = FrameModel(replace(STEEL.drawing, ribs=ribs), STEEL.material)
    errors = []
    for model in (feet, FrameModel(STEEL.drawing, STEEL.material)):
        press = Press(model, STEEL, 0.020, 0.0647)
        forces = [np.linalg.norm(press.to(depth).force) for depth in MEASURED]
        errors.append(np.sqrt(np.mean((np.array(forces) - list(MEASURED.values())) ** 2)))
    assert errors[0] < 0.3
    assert errors[1] > 1.0
