"""Stress of the mechanics: the energy weight, stiffness from 1e3 to 1e12 Pa, nu near 0.5, loads into buckling."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from finforce_eval.stress.mechanics_jaw import (
    MODULUS,
    Pushed,
    Pusher,
    Rig,
    build_jaw,
    build_own_mechanics,
    measure_condition,
)
from finforce_eval.stress.press import Bench
from finforce_eval.stress.session import open_session, update
from finforce_eval.stress.stress import Family, Plan, Trial, attempt
from finforce_ifea.contact_mechanics.forward_press import RigidBox, RigidCylinder
from finforce_ifea.errors import ContactError
from finforce_ifea.fem.locking import warn_of_locking
from finforce_ifea.fem.solid import SolidModel
from finforce_ifea.fem.tetrahedra import to_tet4, to_tet10
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.jaw.mesh import VolumeMesh
from finforce_ifea.observation import Solution
from finforce_ifea.paper_inverse import InverseResult, solve_inverse

FORMS = ("paper", "sofa")
WEIGHTS = (0.0, *10.0 ** np.arange(-6, 7))
MODULI = tuple(float(f"1e{power}") for power in range(3, 13))
RATIOS = (0.0, 0.3, 0.45, 0.48, 0.49, 0.495, 0.499)
# What a force may be off by where only rounding is left, and where the elements of a mesh are what they are.
ROUNDING, LOCKED = 1e-6, 0.2
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
    """Yields known forces found again with energy weights from 0 to 1e6: ever less, and stated with their bias."""
    jaw = build_jaw()
    mechanics = build_own_mechanics(plan, jaw)
    for seed in range(plan.share(4)):
        random = plan.random("epsilon", seed)
        height, size = random.uniform(0.02, 0.06), random.uniform(0.2, 3.0)
        pushed = Pusher(mechanics, jaw, height).push(size)
        for form in FORMS:
            yield from _weigh(seed, pushed, form)


def _weigh(seed: int, pushed: Pushed, form: str) -> Iterator[Trial]:
    """Yields the same problem with one energy weight after the other."""
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
    """Returns a trial whose deviation is infinite when the force is larger than with the weight before."""
    trial = judge_inverse(result, pushed)
    force = float(np.linalg.norm(result.forces.sum(0)))
    rises = force > most * (1.0 + ROUNDING)
    return replace(trial, deviation=np.inf if rises else trial.deviation, note=f"{force:.9g}")


def judge_inverse(result: InverseResult, pushed: Pushed) -> Trial:
    """Returns how the force of an inverse problem compares; its deviation is noise, bias and rounding together."""
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


def run_modulus(plan: Plan) -> Iterator[Trial]:
    """Yields presses and estimates of jaws from 1e3 to 1e12 Pa, whose forces go with Young's modulus to rounding."""
    for height in (0.02, 0.04, 0.06):
        expected = None
        for modulus in (MODULUS, *MODULI):
            jaw = build_jaw(modulus)
            rig = Rig(mechanics=build_own_mechanics(plan, jaw), jaw=jaw, height=height)
            expected = rig.press(4e-3)[1].force / modulus if expected is None else expected
            yield attempt(
                plan.seed,
                lambda r=rig: r.press(4e-3),
                lambda got, r=rig, f=modulus * expected: r.judge(got, f, ROUNDING),
                level=f"{modulus:.0e} Pa, pressed",
            )
    for seed in range(plan.share(2)):
        yield from _scale_estimates(plan, seed)


def _scale_estimates(plan: Plan, seed: int) -> Iterator[Trial]:
    """Yields the same noisy press, estimated with one modulus after the other."""
    first = estimate_press(plan, seed, MODULUS)
    for modulus in MODULI:
        yield attempt(
            seed,
            lambda m=modulus: estimate_press(plan, seed, m),
            lambda got, m=modulus: _judge_scaled(got, first, m / MODULUS),
            level=f"{modulus:.0e} Pa, estimated",
        )


def estimate_press(plan: Plan, seed: int, modulus: float) -> Solution:
    """Returns what an estimator of a jaw of some modulus [Pa] says at the end of a press with noise."""
    bench = Bench(plan, jaw=build_jaw(modulus))
    course = bench.course(height=0.04, radius=0.0125, depth=3e-3)
    session = open_session(bench, plan.random("modulus", seed), course=course)
    return [update(bench, step) for step in session.press()][-1]


def _judge_scaled(solution: Solution, first: Solution, ratio: float) -> Trial:
    error = float(np.linalg.norm(solution.force - ratio * first.force))
    return Trial(
        converged=solution.converged,
        sure=solution.trusted,
        residual=solution.residual,
        kkt=solution.kkt,
        force_error=error,
        stddev=ROUNDING * ratio * float(np.linalg.norm(first.force)),
        step_time=np.nan,
        nan=not np.isfinite(solution.force).all(),
        note=solution.status,
    )


def run_poisson(plan: Plan) -> Iterator[Trial]:
    """Yields the stiffness of every kind of element from nu = 0 to 0.499: right within 20 %, or warned of."""
    for ratio in RATIOS:
        jaw = build_jaw(ratio=ratio)
        expected = measure_compliance(jaw, jaw.build_mesh("fine"))
        for name, change in (("hexahedra", lambda m: m), ("10-node", to_tet10), ("4-node", to_tet4)):
            for density in ("coarse", "default")[: 1 if name == "4-node" else 2]:
                mesh = change(jaw.build_mesh(density))
                yield attempt(
                    plan.seed,
                    lambda m=mesh, j=jaw: measure_warned(j, m),
                    lambda got, e=expected: _judge_compliance(got, e),
                    level=f"{name} {density}, nu {ratio:g}",
                )


@dataclass(frozen=True, kw_only=True, eq=False)
class Compliance:
    """Motion per force [m/N], what is left of the equations, a condition number, whether locking is warned of."""

    value: float
    residual: float
    condition: float
    warned: bool = False


def measure_compliance(jaw: Jaw, mesh: VolumeMesh) -> Compliance:
    """Returns the compliance of a mesh against a force along -x at the middle of its inner surface."""
    model = SolidModel(mesh, jaw.material)
    rest, point = np.zeros(model.size), np.array([[jaw.inner_face_x, 0.0, 0.04]])
    probe, state = model.attach(point, 1e-3), model.linearize(rest)
    load = model.load(probe, rest, np.array([[-1.0, 0.0, 0.0]]))
    motion = model.factorise(state.tangent).solve(load)
    left = np.abs(model.sparse_tangent(state.tangent) @ motion - load).max() / np.abs(load).max()
    return Compliance(value=float(load @ motion), residual=float(left), condition=measure_condition(model, rest))


def measure_warned(jaw: Jaw, mesh: VolumeMesh) -> Compliance:
    """Returns the compliance and whether this mesh's locking would be warned of, were it a file."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        warn_of_locking(replace(jaw, drawing=None), mesh)
    return replace(measure_compliance(jaw, mesh), warned=bool(said))


def _judge_compliance(found: Compliance, expected: Compliance) -> Trial:
    force = expected.value / found.value
    return Trial(
        converged=True,
        sure=not found.warned,
        residual=found.residual,
        force_error=abs(force - 1.0),
        stddev=LOCKED / 3.0,
        condition=found.condition,
        nan=not np.isfinite(force),
        note=f"{force:.3f} times as stiff as fine hexahedra" + ", warned of" * found.warned,
    )


def run_pressing(plan: Plan) -> Iterator[Trial]:
    """Yields presses from 1e-4 to 1e3 N, and on until the jaw buckles: in equilibrium and stable, or refused."""
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
    """Yields forces along the finger and across its tip, through its limit points, found again from key points."""
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


FAMILIES = (
    Family(name="epsilon", what="the energy weight from 0 to 1e6 in both its forms", run=run_epsilon, timed=False),
    Family(name="modulus", what="Young's modulus from 1e3 to 1e12 Pa", run=run_modulus, least_sure=0.9, timed=False),
    Family(
        name="poisson", what="Poisson's ratio from 0 to 0.499 in every kind of element", run=run_poisson, timed=False
    ),
    Family(name="pressing", what="presses from 1e-4 to 1e3 N and into buckling", run=run_pressing, timed=False),
    Family(name="buckling", what="loads through the finger's limit points", run=run_buckling, timed=False),
)
