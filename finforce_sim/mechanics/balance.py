"""One or two jaws in equilibrium with an object between them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.contact_mechanics.pressed_jaw import limit_step
from finforce_ifea.grasp_force import R_GRIPPER_JAW
from finforce_sim.errors import BalanceError
from finforce_sim.mechanics.pressed_jaw import JawShape, JawStep, Load, PressedJaw

_SETTLED = 1e-6  # [m] of the last Newton step, a hundredth of what a camera sees
_LEAST_PULL = 0.02  # [N] that sticks anyhow
_ITERATIONS = 40
_SHORTEST = 1.0 / 128.0  # of the way from one image to the next
_LARGEST_SHIFT = 1e-3  # [m] of the object in one Newton step
_SOFTEST = 1e-3  # [N/m] of both jaws together, below which a balance tells nothing of the object's place
_STRONGEST = 50.0  # [N]; fingers that bend give way far below


@dataclass(frozen=True, kw_only=True, eq=False)
class GraspSetting:
    """What the jaws are told to do.

    Attributes:
        opening: of the jaws' origins from the middle [m].
        height: z of the object's origin [m].
        tilt: of the object from x to z [rad].
        weight: (3,) [N] in `gripper_base`.
    """

    opening: float
    height: float
    tilt: float
    weight: NDArray

    def between(self, other: "GraspSetting", share: float) -> "GraspSetting":
        """Returns the setting that lies the share [-] of the way towards another."""
        mine, theirs = vars(self), vars(other)
        return GraspSetting(**{key: mine[key] + share * (theirs[key] - mine[key]) for key in mine})


@dataclass(frozen=True, kw_only=True, eq=False)
class _Balance:
    """An equilibrium: unknowns (size,) and loads of each jaw, and the object's x [m]."""

    q: Mapping[str, NDArray]
    loads: Mapping[str, Load | None]
    x: float


class HeldObject:
    """An object between the jaws, free along x, or before a single jaw at x = 0; height and tilt are given.

    The pressure follows from the shapes and has no friction. What it and the weight leave along y and z is taken up by
    the jaws' surfaces as a pull, each in proportion to its pressure, unless a hand guides the object.

    Attributes:
        creep: speed at which the object slides along z [m/s]: what the pulls have beyond the friction, over the drag.
    """

    def __init__(self, jaws: Mapping[str, PressedJaw], x: float, *, guided: bool, friction: float, drag: float) -> None:
        """Starts with jaws at rest.

        Args:
            jaws: by side.
            x: of the object [m].
            guided: whether a hand holds the object.
            friction: share of a pressure that the pull may have before the object slides.
            drag: of a sliding object [N s/m]; 0: it would fall, which is an error.
        """
        self._jaws, self._guided, self._is_free = jaws, guided, len(jaws) > 1
        self._friction, self._drag, self.creep = friction, drag, 0.0
        rest = {side: np.zeros(jaw.model.size) for side, jaw in jaws.items()}
        self._balance = _Balance(q=rest, loads=dict.fromkeys(jaws), x=x if self._is_free else 0.0)
        self._setting: GraspSetting | None = None
        self._before: _Balance | None = None

    @property
    def x(self) -> float:
        """Where the object is on the closing axis [m]."""
        return self._balance.x

    def follow(self, setting: GraspSetting) -> Mapping[str, JawShape]:
        """Moves to a setting and returns the jaws' shapes; the way is halved where Newton's method does not converge.

        Raises:
            BalanceError: There is no equilibrium, or the object would slip or fall.
        """
        start, reached, step = self._setting or setting, 0.0, 1.0
        while reached < 1.0:
            share = min(reached + step, 1.0)
            balance = self._solve(start.between(setting, share))
            if balance is not None:
                self._before = self._balance if step == 1.0 else None
                self._balance, reached = balance, share
                continue
            self._before, step = None, 0.5 * step
            if step < _SHORTEST:
                raise BalanceError(
                    f"no equilibrium at an opening of {1e3 * setting.opening:.2f} mm: a jaw buckles or slips off; "
                    "close less far or grasp at another height"
                )
        self._setting = setting
        q, loads = self._balance.q, self._balance.loads
        return {side: jaw.describe(q[side], loads[side]) for side, jaw in self._jaws.items()}

    def _solve(self, setting: GraspSetting) -> _Balance | None:
        """Returns the balance at a setting, None when Newton's method does not find it."""
        gaps = {side: self._gap(side, setting) for side in self._jaws}
        if sum(gaps.values()) >= 0.0:
            return self._release(setting, gaps)
        q, x = self._predict(gaps)
        for _ in range(_ITERATIONS):
            loads = self._find_loads(q, x, setting)
            steps = {side: jaw.linearize(q[side], loads[side]) for side, jaw in self._jaws.items()}
            if not all(step.smallest_det > 0.0 for step in steps.values()):
                return None
            dx = self._find_shift(steps, setting)
            moves = {side: step.correction + _along(side) * dx * step.mode for side, step in steps.items()}
            cut = min(_cut(self._jaws[side], move) for side, move in moves.items())
            q, x = {side: q[side] + cut * move for side, move in moves.items()}, x + cut * dx
            change = max(np.abs(move).max() for move in moves.values())
            if not np.isfinite(change):
                return None
            if change < _SETTLED:
                loads = self._find_loads(q, x, setting)
                self._check_grip(steps, loads)
                return _Balance(q=q, loads=loads, x=x)
        return None

    def _predict(self, gaps: Mapping[str, float]) -> tuple[dict[str, NDArray], float]:
        """Returns where the search begins: on as it went, or with the object in the middle when first touched."""
        last = self._balance
        if not all(load is not None for load in last.loads.values()):
            return dict(last.q), 0.5 * (gaps["right"] - gaps["left"]) if self._is_free else last.x
        if self._before is None:
            return dict(last.q), last.x
        return {side: 2.0 * last.q[side] - self._before.q[side] for side in last.q}, 2.0 * last.x - self._before.x

    def _find_loads(self, q: Mapping[str, NDArray], x: float, setting: GraspSetting) -> dict[str, Load]:
        """Returns each jaw's load: the object's place, and as pull what pressures leave of the weight in y and z."""
        loads = {
            side: Load(
                origin=np.array([setting.opening + _along(side) * x, setting.height]),
                tilt=_along(side) * setting.tilt,
                pull=np.zeros(3),
            )
            for side in q
        }
        if self._guided:
            return loads
        pressures = {side: jaw.find_pressure(q[side], loads[side]) for side, jaw in self._jaws.items()}
        sizes = {side: float(np.linalg.norm(pressure)) for side, pressure in pressures.items()}
        total = sum(sizes.values())
        rest = setting.weight - sum(R_GRIPPER_JAW[side] @ pressure for side, pressure in pressures.items())
        rest = rest * (0.0, 1.0, 1.0) / total if total > 0.0 else np.zeros(3)
        return {side: replace(load, pull=sizes[side] * R_GRIPPER_JAW[side].T @ rest) for side, load in loads.items()}

    def _gap(self, side: str, setting: GraspSetting) -> float:
        """Returns how far [m] the object at x = 0 is from first touch with a jaw at rest."""
        return setting.opening - self._jaws[side].find_touch(setting.height, _along(side) * setting.tilt)

    def _release(self, setting: GraspSetting, gaps: Mapping[str, float]) -> _Balance:
        """Returns jaws at rest, and the object where it was unless a jaw has pushed it."""
        if np.abs(setting.weight).max() > 0.0:
            raise BalanceError(f"the jaws let go of {np.linalg.norm(setting.weight):.2f} N; set the object down first")
        self.creep = 0.0
        rest = {side: np.zeros(jaw.model.size) for side, jaw in self._jaws.items()}
        x = float(np.clip(self.x, -gaps["left"], gaps["right"])) if self._is_free else 0.0
        return _Balance(q=rest, loads=dict.fromkeys(self._jaws), x=x)

    def _find_shift(self, steps: Mapping[str, JawStep], setting: GraspSetting) -> float:
        """Returns the object's way dx [m] that balances the pushes: sum of +-(push +- slope dx) = weight_x."""
        slope = sum(step.slope for step in steps.values())
        if not self._is_free or slope < _SOFTEST:
            return 0.0
        push = sum(_along(side) * step.push for side, step in steps.items())
        return float(np.clip((setting.weight[0] - push) / slope, -_LARGEST_SHIFT, _LARGEST_SHIFT))

    def _check_grip(self, steps: Mapping[str, JawStep], loads: Mapping[str, Load]) -> None:
        self.creep = 0.0
        for side, load in loads.items():
            pressure, needed = np.linalg.norm(steps[side].force), np.linalg.norm(load.pull)
            if pressure > _STRONGEST:
                raise BalanceError(
                    f"the {side} jaw is pressed with {pressure:.0f} N, more than such a finger bears: the object meets "
                    "its clamped base; close less far or raise the object's height"
                )
            held = self._friction * pressure
            if needed <= held + _LEAST_PULL:
                continue
            if self._drag == 0.0:
                raise BalanceError(
                    f"the object slips: the {side} jaw must pull with {needed:.2f} N and holds at most {held:.2f} N; "
                    "close further, or lift less"
                )
            self.creep += (needed - held) * float(load.pull[2]) / needed / self._drag


def _along(side: str) -> float:
    """Returns the sign of a jaw's x axis in the gripper; a tilt from x to z has the same sign."""
    return float(R_GRIPPER_JAW[side][0, 0])


def _cut(jaw: PressedJaw, move: NDArray) -> float:
    """Returns the share [-] of a Newton step that moves no node too far at once."""
    size = np.abs(move).max()
    return float(np.abs(limit_step(jaw.model, move)).max() / size) if size > 0.0 else 1.0
