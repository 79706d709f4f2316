"""Presses of a known force on a jaw, and an estimator of that jaw."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from finforce_eval.stress.stress import Plan
from finforce_ifea.contact_mechanics.forward_press import PressState, RigidCylinder, press_jaw
from finforce_ifea.contact_mechanics.penalty import measure_penalty_energy
from finforce_ifea.errors import ContactError
from finforce_ifea.estimator import JawEstimator
from finforce_ifea.jaw.calibration import Calibration
from finforce_ifea.jaw.jaw import Jaw, load_jaw
from finforce_ifea.mechanics import build_mechanics
from finforce_ifea.settings import EstimatorSettings

# The truth comes from the estimator's own mechanics: no more than this share of a force is left to it.
FORCE_ERROR = 0.01
COURSE_STEPS = 16
OWN_MECHANICS = ("solid", "frame")


@dataclass(frozen=True, kw_only=True, eq=False)
class PressHistory:
    """A jaw pressed ever deeper by a cylinder.

    Attributes:
        height: of first touch [m].
        radius: of the cylinder [m].
        depth: the largest [m].
        keypoints: by depth, (n,) -> (n, K, 3) [m].
        forces: by depth, (n,) -> (n, 3) [N].
        torques: by depth, (n,) -> (n, 3) [N m].
        balance: work of the object less energy stored, relative to the energy.
    """

    height: float
    radius: float
    depth: float
    keypoints: PchipInterpolator
    forces: PchipInterpolator
    torques: PchipInterpolator
    balance: float


class Bench:
    """One jaw with an estimator, and the same mechanics to press it with."""

    def __init__(self, plan: Plan, *, modulus: float = 1.0, jaw: Jaw | None = None, **settings) -> None:
        """Builds the bench jaw, or another one, with `modulus` times its Young's modulus."""
        self.plan = plan
        jaw = jaw or load_jaw("bench")
        calibration = Calibration(
            young_modulus=modulus * jaw.material.young_modulus, force_error=FORCE_ERROR, clamped_z=0.0
        )
        chosen = EstimatorSettings(solver=plan.solver, mesh=plan.mesh, **settings)
        self.estimator = JawEstimator(jaw, settings=chosen, calibration=calibration)
        self.estimator.warm_up()
        self.jaw = self.estimator.jaw
        own, full = plan.solver in OWN_MECHANICS, replace(chosen, solver=self.jaw.model)
        self.mechanics = self.estimator.mechanics if own else build_mechanics(self.jaw, full)

    def press(self, random: np.random.Generator, *, depth: float | None = None) -> PressHistory:
        """Returns a press by a drawn cylinder at a drawn height, `depth` [m] deep or drawn too.

        A press that slips off or buckles is drawn anew.
        """
        while True:
            height, radius = random.uniform(0.018, 0.062), np.exp(random.uniform(np.log(5e-3), np.log(25e-3)))
            deepest = np.exp(random.uniform(np.log(0.3e-3), np.log(8e-3))) if depth is None else depth
            try:
                return self.course(height=height, radius=radius, depth=deepest)
            except ContactError:
                continue

    def course(self, *, height: float, radius: float, depth: float) -> PressHistory:
        """Returns the press of a cylinder; raises ContactError where there is no equilibrium."""
        model, surface = self.mechanics.model, self.mechanics.contact.surface
        depths = np.linspace(0.0, depth, COURSE_STEPS + 1)[1:]
        presses = press_jaw(model, surface, self.jaw.inner_face_x, RigidCylinder(radius=radius), height, depths)
        probe = model.attach(self.jaw.keypoints, 1.0)
        points = np.stack([model.positions(probe, press.q) for press in presses])
        grid, rest = np.r_[0.0, depths], model.positions(probe, np.zeros(model.size))
        zero = np.zeros((1, 3))
        return PressHistory(
            height=height,
            radius=radius,
            depth=depth,
            keypoints=PchipInterpolator(grid, np.concatenate([rest[None], points])),
            forces=PchipInterpolator(grid, np.concatenate([zero, [press.force for press in presses]])),
            torques=PchipInterpolator(grid, np.concatenate([zero, [press.torque for press in presses]])),
            balance=self._balance(presses, RigidCylinder(radius=radius), height, grid),
        )

    def _balance(self, presses: list[PressState], rigid: RigidCylinder, height: float, grid: NDArray) -> float:
        """Returns work less energy of a press, over the energy; that of the springs of the surface counts."""
        model, surface = self.mechanics.model, self.mechanics.contact.surface
        pushes = np.array([0.0, *(-press.force[0] for press in presses)])
        work = float(PchipInterpolator(grid, pushes).integrate(grid[0], grid[-1]))
        points = model.positions(surface.probe, presses[-1].q)
        contact = rigid.press(points, surface.stiffness, self.jaw.inner_face_x, presses[-1].depth, height)
        energy = presses[-1].energy + measure_penalty_energy(contact.forces, surface.stiffness)
        return (work - energy) / max(work, energy)
