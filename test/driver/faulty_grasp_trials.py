"""Grasps by force in which something goes wrong, judged by the true force on the object.

Each case is one grasp of 1 to 5 N on fingers of 0.3 to 1.3 N/mm, on either firmware variant in stepped time: up to six
random faults on the line, in the gripper or of its cable; in most cases a camera that is blind, freezes, dies, lags,
reads low, jumps or speaks nonsense for a while; and a user who stops, presses the emergency stop or lets it hold.

| complaint | |
|---|---|
| pressed | the true force was above the limit of a grasp by force, 8 N |
| holds something else | it reports holding, camera and link were sound for a second, and the true force is off by 1 N |
| ready in motion | the gripper reports ready while its jaws close |
| motion after stop | the jaws close by more than two counts after the grasp ended, was stopped or failed |
| not told | the grasp failed, and no reason was given |
"""

from __future__ import annotations

import math
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from random import Random
from typing import Any

import numpy as np
from emulator_faults import FaultKind, FaultyAdapter, FaultyBus, PlannedFault
from fault_trials import Tally
from grasp_fakes import build_spring

from finforce_driver.errors import BackOffError, DriverError, GripperTimeoutError
from finforce_driver.grasp.force_monitor import ForceSample
from finforce_driver.grasp.session import hold_force
from finforce_driver.settings import GraspGoal, GraspSettings
from finforce_driver.state import GraspPhase, GraspStatus, GripperState, MoveOutcome, Phase
from finforce_sim.emulator.control import Mode
from lab.experiments.grasp_world import GraspCase, NoisySensor, Plant, World

LIMIT = GraspSettings().force_limit  # [N]
FAULTS_FROM, PERIOD, MOST = 1.2, 0.5, 6  # [s], [s], faults of the line and the gripper
HELD = 1.5  # [s] that is held before the user is content
WATCHED = 1.2  # [s] after the end
SOUND = 1.0  # [s] for which camera and link have to have been sound for a held force to be judged
DEBOUNCED = 0.1  # [s] in which jaws of a gripper that reports ready may come to rest
SILENT = 0.15  # [s] without a believed reply after which the link counts as lost
SETTLED = 0.3  # [s] in which a stop may take effect, from when the link is there
CREEP = 2.2  # [counts] of closing that are none
# left out: another program that drives the jaws, a gripper that takes itself for none and lets go of them unseen (both
# in fault_trials.py), and a calibration that finds no stop
_LEFT_OUT = (FaultKind.OTHER_MASTER, FaultKind.STUCK, FaultKind.SLIPPING)
KINDS = tuple(kind for kind in FaultKind if kind not in _LEFT_OUT)
CAMERA = ("sound", "blind", "frozen", "dead", "slow", "low", "jumping", "nonsense", "negative")


class FaultyCamera:
    """A camera with noise that is at fault for a while.

    Attributes:
        touching: unknown.
        stddev: stated [N].
        kind: of the fault.
        span: when it begins and ends [s], after the first image.
    """

    touching = None
    stddev = 0.0

    def __init__(self, kind: str, span: tuple[float, float], seed: int) -> None:
        self.kind, self.span = kind, span
        self._noise, self._random = NoisySensor(0.05, seed), Random(seed)
        self._last, self._begin = 0.0, math.nan

    def is_sound(self, now: float) -> bool:
        """Whether the camera was all right for the last while at a time [s]."""
        begin = now - self._begin
        return self.kind == "sound" or not (self.span[0] < begin + 0.1 and begin - SOUND < self.span[1])

    def measure(self, stamp: float, force: float, opening: float) -> float | None:
        """Return what an image shows."""
        if math.isnan(self._begin):
            self._begin = stamp
        seen = self._noise.measure(stamp, force, opening)
        if not self.span[0] < stamp - self._begin < self.span[1]:
            self._last = seen
            return seen
        wrong = {
            "blind": 0.0,
            "frozen": self._last,
            "dead": None,
            "low": 0.7 * seen,
            "jumping": self._random.choice((0.0, seen, 2.0 * seen + 1.0)),
            "nonsense": self._random.choice((math.nan, math.inf, -5.0, 1e9, seen)),
            "negative": -0.1 * self._random.random(),
        }
        return wrong.get(self.kind, seen)


@dataclass(kw_only=True)
class GraspTally(Tally):
    """What came of grasps.

    Attributes:
        cases: number of them.
        faults: that were injected, by kind.
        cameras: cases by the camera's fault.
        ends: how grasps ended, by the first words of the reason.
        complaints: by name.
        wrong: seeds of the cases with a complaint.
        excess: largest true force less the set one of each case [N].
    """

    cases: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    cameras: Counter[str] = field(default_factory=Counter)
    ends: Counter[str] = field(default_factory=Counter)
    complaints: Counter[str] = field(default_factory=Counter)
    wrong: list[int] = field(default_factory=list)
    excess: list[float] = field(default_factory=list)

    def plain(self) -> dict[str, Any]:
        """Return counts by what they count, and percentiles of the excess [N]."""
        values = np.quantile(self.excess, (0.5, 0.95, 0.99, 1.0)).tolist()
        return {**super().plain(), "excess": dict(zip(("median", "p95", "p99", "max"), values, strict=True))}


class FaultyGrasp(World):
    """One grasp in which something goes wrong.

    Args:
        seed: of everything random.
    """

    def __init__(self, seed: int) -> None:
        self._draw = draw = Random(seed)
        stiffness, rise = draw.choice(((300.0, 1.0), (700.0, 1.0), (1300.0, 1.0), (400.0, 3.0)))
        goal, variant = draw.uniform(1.0, 5.0), draw.choice(("new", "old"))
        plant = Plant(force_at=build_spring(stiffness, rise))
        speed, latency = draw.choice((0.004, 0.008, 0.04)), draw.choice((0.03, 0.06, 0.1))
        case = GraspCase(plant=plant, force=goal, speed=speed, latency=latency, seed=seed, variant=variant)
        start = draw.uniform(0.0, 3.0)
        camera = FaultyCamera(draw.choice(CAMERA), (start, start + draw.uniform(0.1, 3.0)), seed)
        self._faults = self._plan(draw)
        super().__init__(case, camera)
        self.tally = GraspTally(cases=1)
        self._camera, self._seed = camera, seed
        self._act = draw.choice(("stop", "stop", "estop", "none", "none", "none"))
        self._act_at = draw.uniform(0.1, 4.0)
        self._began = self._ended = math.nan
        self._least = math.inf  # opening [m] since the end was to have taken effect
        self._unlinked = -math.inf  # when the link was last seen to be lost [s]
        self._ready_at, self._ready_opening, self._outcome = math.inf, math.inf, MoveOutcome.NONE
        self.gripper.listen(self._check_state)

    def _connect(self) -> FaultyBus:
        self.adapter = FaultyAdapter(self.emulated, self._faults, self._case.seed)
        return FaultyBus(self.adapter, self.clock)

    def play(self) -> GraspTally:
        """Play the grasp and return what came of it."""
        self._prepare()
        self._began = self.clock.now()
        goal = GraspGoal(force=self._case.force, speed=self._case.speed, time_limit=8.0)
        backing, end = False, "was content"
        try:
            hold_force(self.gripper, self.take, goal, until=self._is_over)
        except DriverError as error:
            backing, end = isinstance(error, BackOffError), str(error)
            if not end:
                self._complain("not told")
        self._ended = self.clock.now()
        if not backing:
            with suppress(DriverError):
                self.gripper.hold()
        with suppress(GripperTimeoutError):
            self.gripper.wait(lambda _: False, WATCHED)
        tally = self.tally
        tally.faults.update(fault.kind.value for fault in self.adapter.injected)
        tally.cameras[self._camera.kind] += 1
        tally.ends[" ".join(end.split()[:3])] += 1
        tally.excess.append(max(self.trace.forces) - self._case.force)
        if tally.complaints:
            tally.wrong.append(self._seed)
        return tally

    def step(self, dt: float) -> None:
        """Advance the fingers and check them."""
        super().step(dt)
        now = self.clock.now()
        if not self.adapter.plugged or not now - self.gripper.state.stamp <= SILENT:
            self._unlinked = now
        if self.force > LIMIT:
            self._complain("pressed")
        self._check_rest(now)

    def _make_ready(self) -> None:
        """Take the gripper as calibrated, to save the time."""
        self.emulated.calibrated = True
        self.gripper.wait(lambda state: state.phase is Phase.READY, 5.0)

    def _clearance(self) -> float:
        """Return how far before the first touch the jaws stand [m]."""
        return self._draw.uniform(0.0005, 0.003)

    def take(self) -> list[Any]:
        """Return the forces that have arrived; those of a slow camera come late."""
        samples = super().take()
        slow = self._camera.kind == "slow" and not self._camera.is_sound(self.clock.now())
        if not slow:
            return samples
        return [ForceSample(stamp=one.stamp - 0.4, arrived=one.arrived, force=one.force) for one in samples]

    def _is_over(self, status: GraspStatus) -> bool:
        """Do what the user does, and check what the grasp reports."""
        now = self.clock.now()
        if math.isnan(self.trace.held_at) and status.phase is GraspPhase.HOLDING:
            self.trace.held_at = now
        sound = self._camera.is_sound(now) and now - self._unlinked > SOUND
        settled = now - self.trace.held_at > SOUND and self.emulated.mode is Mode.GRIPPER
        if status.phase is GraspPhase.HOLDING and sound and settled and abs(self.force - status.goal) > 1.0:
            self._complain("holds something else")
        if now - self._began > self._act_at and self._act != "none":
            act, self._act = self._act, "none"
            if act == "estop":
                self.gripper.estop()
            return act == "stop"
        return now - self.trace.held_at > HELD

    def _check_state(self, state: GripperState) -> None:
        """Check what the gripper reports: it is not ready while it closes."""
        opening, now = self.emulated.jaws.opening, self.clock.now()
        if state.phase is not Phase.READY or state.outcome is not self._outcome or now - self._unlinked < SETTLED:
            self._ready_at, self._ready_opening = now, math.inf
        elif now - self._ready_at > DEBOUNCED:
            self._ready_opening = opening if self._ready_opening == math.inf else self._ready_opening
            if (self._ready_opening - opening) / self.gripper.resolution > CREEP:
                self._complain("ready in motion")
        self._outcome = state.outcome

    def _check_rest(self, now: float) -> None:
        """Check whether the jaws close after the end."""
        if not now - max(self._ended, self._unlinked) > SETTLED:
            return
        opening = self.emulated.jaws.opening
        if (self._least - opening) / self.gripper.resolution > CREEP and self._least < math.inf:
            self._complain("motion after stop")
        self._least = opening if self._least == math.inf else self._least

    def _complain(self, what: str) -> None:
        """Count a complaint once a grasp."""
        self.tally.complaints[what] = 1

    @staticmethod
    def _plan(draw: Random) -> list[PlannedFault]:
        return [
            PlannedFault(
                time=FAULTS_FROM + (index + draw.random()) * PERIOD,
                kind=draw.choice(KINDS),
                count=draw.choice((1, 1, 2, 3, 8)),
                duration=draw.uniform(0.05, 1.0),
            )
            for index in range(draw.randint(0, MOST))
        ]


def play_all(cases: int, seed: int = 1) -> GraspTally:
    """Return what came of many grasps."""
    tally = GraspTally()
    with np.errstate(all="ignore"):
        for number in range(seed, seed + cases):
            tally.add(FaultyGrasp(number).play())
    return tally
