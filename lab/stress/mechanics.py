"""Stress of the mechanics: energy weight, presses of any size, buckling."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, onenormest

from finforce_ifea.contact_mechanics.indenter import PenaltyContact
from finforce_ifea.contact_mechanics.pressed_jaw import Mechanics, limit_step
from finforce_ifea.errors import ContactError
from finforce_ifea.fem.model import JawModel, sparse_from_banded
from finforce_ifea.jaw.jaw import KEYPOINT_DISTANCE, Jaw, load_jaw
from finforce_ifea.jaw.jaw_file import Material
from finforce_ifea.mechanics import build_mechanics
from finforce_ifea.paper_inverse import InverseResult, Problem, solve_inverse, surface_normals
from finforce_ifea.settings import EstimatorSettings
from lab.forward_press import PressState, RigidBox, RigidCylinder, RigidObject, measure_penalty_energy, press_jaw
from lab.stress.session import OWN_MECHANICS
from lab.stress.stress import Family, Plan, Trial, attempt

FORMS = ("paper", "sofa")
WEIGHTS = (0.0, *10.0 ** np.arange(-6, 7))
ROUNDING = 1e-6  # of a force, where nothing else is left
# Standard deviation of key points [m] where a load is to be found through a limit point.
SIGHT = 5e-5
DEPTHS = (1e-6, 1e-5, 1e-4, 1e-3, 5e-3, 1e-2, 1.5e-2, 2e-2, 3e-2)
RIGID = (
    RigidCylinder(radius=0.0125),
    RigidCylinder(radius=0.002),
    RigidCylinder(radius=0.5),
    RigidBox(size_x=0.03, size_z=0.01, edge_radius=1e-3),
    RigidBox(size_x=0.03, size_z=0.3, edge_radius=1e-3),
)
DIRECTIONS = (np.array([-0.2, 0.0, -0.98]), np.array([-0.35, 0.0, -0.94]), np.array([-0.6, 0.0, -0.8]))
WAYS = 1e-3 * np.array([0.1, 0.3, 0.6, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 15.0, 20.0])


def run_epsilon(plan: Plan) -> Iterator[Trial]:
    """Yield known forces found again with energy weights from 0 to 1e6: ever less, and stated with their bias."""
    jaw = build_jaw()
    mechanics = build_own_mechanics(plan, jaw)
    for seed in range(plan.share(4)):
        random = plan.random("epsilon", seed)
        height, size = random.uniform(0.02, 0.06), random.uniform(0.2, 3.0)
        pushed = Pusher(mechanics, jaw, height).push(size)
        for form in FORMS:
            yield from _weigh(seed, pushed, form)


def _weigh(seed: int, pushed: Pushed, form: str) -> Iterator[Trial]:
    """Yield the same problem with one energy weight after the other."""
    start, before = np.zeros(pushed.model.size), np.inf
    for weight in WEIGHTS:
        problem = replace(pushed.problem, energy_weight=weight, energy_form=form)
        trial = attempt(
            seed,
            lambda p=problem: solve_inverse(pushed.model, p, start, iterations=40),
            lambda got, most=before: _judge_weighed(got, pushed, most),
            level=f"{form}, eps {weight:g}",
        )
        before = float(trial.note) if trial.outcome == "answer" else before
        yield trial


def _judge_weighed(result: InverseResult, pushed: Pushed, most: float) -> Trial:
    """Return a trial whose deviation is infinite when the force is larger than with the weight before."""
    trial = judge_inverse(result, pushed)
    force = float(np.linalg.norm(result.forces.sum(0)))
    rises = force > most * (1.0 + ROUNDING)
    return replace(trial, deviation=np.inf if rises else trial.deviation, note=f"{force:.9g}")


def judge_inverse(result: InverseResult, pushed: Pushed) -> Trial:
    """Return how the force of an inverse problem compares; its deviation is noise, bias and rounding together."""
    force = result.forces.sum(0)
    error = float(np.linalg.norm(force - pushed.force))
    noise = float(np.sqrt(np.trace(result.directions @ result.covariance @ result.directions.T)))
    noise = noise * SIGHT if pushed.problem.precision is None else noise
    bias = float(np.linalg.norm(result.directions @ result.bias))
    left = result.q @ (pushed.model.linearize(result.q, tangent=False).force) if result.converged else np.nan
    work = float(result.q @ pushed.model.load(pushed.problem.contacts, result.q, result.forces))
    return Trial(
        converged=result.converged,
        sure=result.converged and result.smallest_det > 0,
        residual=result.residual,
        kkt=result.kkt,
        force_error=error,
        stddev=float(np.hypot(np.hypot(noise, bias), ROUNDING * np.linalg.norm(pushed.force))),
        condition=result.condition,
        energy_balance=(work - left) / max(abs(work), 1e-300),
        nan=not np.isfinite([*force, error, noise, bias]).all(),
    )


def run_pressing(plan: Plan) -> Iterator[Trial]:
    """Yield presses from 1e-4 to 1e3 N, and on until the jaw buckles: in equilibrium and stable, or refused."""
    jaw = build_jaw()
    mechanics = build_own_mechanics(plan, jaw)
    for seed in range(plan.share(24)):
        random = plan.random("pressing", seed)
        rigid = RIGID[seed % len(RIGID)]
        rig = Rig(mechanics=mechanics, jaw=jaw, height=random.uniform(0.018, 0.075), rigid=rigid)
        for depth in DEPTHS:
            yield attempt(
                seed,
                lambda r=rig, d=depth: r.press(d),
                lambda got, r=rig: r.judge(got, got[1].force, ROUNDING),
                level=f"{1e3 * depth:g} mm",
            )


def run_buckling(plan: Plan) -> Iterator[Trial]:
    """Yield forces along the finger and across its tip, through its limit points, found again from key points."""
    jaw = build_jaw()
    # a planar model has no third axis
    solver = "solid" if plan.solver == "frame" else plan.solver
    mechanics = build_own_mechanics(replace(plan, solver=solver), jaw, force_axes="three")
    for seed in range(plan.share(4)):
        random = plan.random("buckling", seed)
        pusher = Pusher(mechanics, jaw, random.uniform(0.06, 0.077), axes="three")
        direction = DIRECTIONS[seed % len(DIRECTIONS)]
        q, scatter = np.zeros(mechanics.model.size), SIGHT * random.normal(size=jaw.keypoints.shape)
        for way in WAYS:
            try:
                pushed = pusher.pull(direction, way, q)
            except ContactError:
                break
            problem = replace(
                pushed.problem,
                targets=pushed.problem.targets + scatter,
                precision=np.full(len(scatter), SIGHT**-2),
            )
            noisy = replace(pushed, problem=problem)
            for start in (q, np.zeros_like(q)) if pusher.is_contact(pushed) else ():
                yield attempt(
                    seed,
                    lambda n=noisy, s=start: solve_inverse(n.model, n.problem, s),
                    lambda got, n=noisy: judge_inverse(got, n),
                    level=f"along {direction.tolist()}, {1e3 * way:g} mm, from {'before' if start.any() else 'rest'}",
                )
            q = pushed.q


MODULUS, RATIO = 30e6, 0.45
_NEIGHBOUR = 1e-3
_ITERATIONS = 80
_SETTLED = 1e-12
# Ways to both sides of a depth over which energies are compared, as a share of it.
_LITTLE = 1e-3
# Gauss points across half of the bench finger's width [m].
_SIDES = (-0.00577, 0.00577)


def build_jaw(modulus: float = MODULUS, ratio: float = RATIO) -> Jaw:
    """Return the bench jaw of a material, Young's modulus [Pa] and Poisson's ratio."""
    return replace(load_jaw("bench"), material=Material(young_modulus=modulus, poisson_ratio=ratio))


def build_own_mechanics(plan: Plan, jaw: Jaw, **settings) -> Mechanics:
    """Return the mechanics of the plan's solver, the solid's where that has no tangent of its own."""
    solver = plan.solver if plan.solver in OWN_MECHANICS else "solid"
    return build_mechanics(jaw, EstimatorSettings(solver=solver, mesh=plan.mesh, **settings))


@dataclass(frozen=True, kw_only=True, eq=False)
class Pushed:
    """A jaw in equilibrium with forces that stand at material points.

    Attributes:
        model: its mechanics.
        problem: the inverse problem of its key points.
        q: unknowns.
        force: the sum of the forces (3,) [N].
    """

    model: JawModel
    problem: Problem
    q: NDArray
    force: NDArray


class Pusher:
    """Pushes a jaw at the height of a contact, or pulls it along, and poses the inverse problem of that place."""

    def __init__(self, mechanics: Mechanics, jaw: Jaw, height: float, *, axes: str = "normal") -> None:
        """Attach contact points, their neighbours along the finger and the key points."""
        self.model = mechanics.model
        sides = _SIDES if self.model.rotations is None else (0.0,)
        points = np.array([[jaw.inner_face_x, y, height] for y in sides])
        around = np.repeat(points, 2, axis=0)
        around[::2, 2] -= _NEIGHBOUR
        around[1::2, 2] += _NEIGHBOUR
        self._count = len(points)
        self.problem = Problem(
            effectors=self.model.attach(jaw.keypoints, KEYPOINT_DISTANCE),
            targets=jaw.keypoints,
            contacts=self.model.attach(points, 1e-3),
            neighbours=self.model.attach(around, 1e-3),
            weights=np.ones(self._count),
            axes=axes,
        )
        self._rest = self.model.positions(self.problem.contacts, np.zeros(self.model.size))

    def push(self, size: float, steps: int = 10) -> Pushed:
        """Return the equilibrium with a force of `size` [N] against the surface, reached in `steps`.

        Raises:
            ContactError: There is none that Newton's method finds.
        """
        q = np.zeros(self.model.size)
        for share in np.linspace(0.0, 1.0, steps + 1)[1:]:
            q = self._balance(q, share * size)
        force = self._forces(q, size).sum(0)
        return self._describe(q, force)

    def pull(self, direction: NDArray, way: float, q: NDArray) -> Pushed:
        """Return the equilibrium in which the points have moved by `way` [m] along a direction (3,), from q.

        A stiff spring along the direction holds them there, so that loads beyond a limit point are reached.

        Raises:
            ContactError: There is none that Newton's method finds.
        """
        model, probe = self.model, self.problem.contacts
        spring = 1e3 * MODULUS * 1e-3
        blocks = np.tile(spring * np.outer(direction, direction), (self._count, 1, 1))
        for _ in range(_ITERATIONS):
            moved = (model.positions(probe, q) - self._rest) @ direction
            forces = (spring * (way - moved))[:, None] * direction
            state = model.linearize(q)
            model.stiffen(state.tangent, probe, q, blocks)
            step = model.factorise(state.tangent).solve(model.load(probe, q, forces) - state.force)
            q = q + limit_step(model, step)
            if np.abs(step).max() < 1e-10:
                return self._describe(q, forces.sum(0))
        raise ContactError(f"no equilibrium at {1e3 * way:g} mm along {direction.tolist()}")

    def is_contact(self, pushed: Pushed) -> bool:
        """Whether the surface is pressed and not pulled on, as a contact that cannot pull has it."""
        normals = surface_normals(self.model, self.problem.neighbours, pushed.q)
        return bool((normals @ pushed.force < 0.0).all())

    def _describe(self, q: NDArray, force: NDArray) -> Pushed:
        targets = self.model.positions(self.problem.effectors, q)
        return Pushed(model=self.model, problem=replace(self.problem, targets=targets), q=q, force=force)

    def _forces(self, q: NDArray, size: float) -> NDArray:
        return -size / self._count * surface_normals(self.model, self.problem.neighbours, q)

    def _balance(self, q: NDArray, size: float) -> NDArray:
        for _ in range(_ITERATIONS):
            state = self.model.linearize(q)
            if not state.smallest_det > 0:
                break
            load = self.model.load(self.problem.contacts, q, self._forces(q, size))
            step = self.model.factorise(state.tangent).solve(load - state.force)
            q = q + limit_step(self.model, step)
            if np.abs(step).max() < _SETTLED:
                return q
        raise ContactError(f"no equilibrium with {size:g} N")


@dataclass(frozen=True, kw_only=True, eq=False)
class Rig:
    """A jaw and the rigid object that is pressed into it at a height [m]."""

    mechanics: Mechanics
    jaw: Jaw
    height: float
    rigid: RigidObject = RigidCylinder(radius=0.0125)

    def press(self, depth: float) -> list[PressState]:
        """Return the equilibria a little before a depth [m], at it and a little beyond."""
        surface, face = self.mechanics.contact.surface, self.jaw.inner_face_x
        depths = [share * depth for share in (1.0 - _LITTLE, 1.0, 1.0 + _LITTLE)]
        return press_jaw(self.mechanics.model, surface, face, self.rigid, self.height, depths)

    def judge(self, presses: list[PressState], expected: NDArray, tolerance: float) -> Trial:
        """Return how a press compares with an expected force (3,) [N], within three times a share of it.

        The residual is what is left of the equilibrium, over the force. The energy balance is that of the way from the
        first to the last of the presses: the work -F_x dx less what jaw and surface store, over the work.
        """
        model, surface, middle = self.mechanics.model, self.mechanics.contact.surface, presses[1]
        contact = self._press(middle)
        state = model.linearize(middle.q)
        left = np.abs(model.load(surface.probe, middle.q, contact.forces) - state.force).max()
        size = float(np.linalg.norm(middle.force))
        before, after = (self._measure_energy(press) for press in (presses[0], presses[2]))
        work = -middle.force[0] * (presses[2].depth - presses[0].depth)
        return Trial(
            converged=True,
            sure=True,
            residual=float(left) / max(size, 1e-300),
            force_error=float(np.linalg.norm(middle.force - expected)),
            stddev=tolerance * size / 3.0,
            condition=measure_condition(model, middle.q),
            energy_balance=(work - (after - before)) / max(abs(work), 1e-300),
            nan=not np.isfinite(middle.force).all(),
            note=f"{size:.4g} N",
        )

    def _press(self, press: PressState) -> PenaltyContact:
        surface = self.mechanics.contact.surface
        points = self.mechanics.model.positions(surface.probe, press.q)
        return self.rigid.press(points, surface.stiffness, self.jaw.inner_face_x, press.depth, self.height)

    def _measure_energy(self, press: PressState) -> float:
        return press.energy + measure_penalty_energy(
            self._press(press).forces, self.mechanics.contact.surface.stiffness
        )


def measure_condition(model: JawModel, q: NDArray) -> float:
    """Return an estimate of the condition number of the tangent stiffness at q in the 1-norm."""
    stored = model.linearize(q).tangent
    matrix = sparse_from_banded(stored) if isinstance(stored, np.ndarray) else model.sparse_tangent(stored)
    factor = model.factorise(stored)
    inverse = LinearOperator(matrix.shape, matvec=factor.solve, rmatvec=factor.solve, dtype=float)
    return float(onenormest(matrix) * onenormest(inverse))


FAMILIES = (
    Family(name="epsilon", what="the energy weight from 0 to 1e6 in both its forms", run=run_epsilon, timed=False),
    Family(name="pressing", what="presses from 1e-4 to 1e3 N and into buckling", run=run_pressing, timed=False),
    Family(name="buckling", what="loads through the finger's limit points", run=run_buckling, timed=False),
)
