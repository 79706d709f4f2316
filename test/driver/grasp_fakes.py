"""A grasp without hardware: jaws that follow commands in steps, fingers that relax, a camera that is late and noisy."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from finforce_driver.grasp.controller import ForceGrasp
from finforce_driver.grasp.force_monitor import ForceSample
from finforce_driver.settings import GraspGoal, GraspSettings
from finforce_driver.state import GraspPhase, GraspStatus, GripperState, Phase

STEP = 0.048 / 255
DT = 0.002
RELAXATION = ((0.08, 2.0), (0.07, 10.0))  # shares and times [s], as the twin draws them


WIDTH = 0.025  # [m] of an object between springs


def build_spring(stiffness: float, rise: float = 1.0) -> Callable[[float], float]:
    """The force [N] at an opening [m] of a spring [N/m] whose stiffness grows `rise` times within 4 mm."""
    bend = spring(stiffness, rise, 0.004)
    return lambda opening: bend(WIDTH - opening)


def spring(stiffness: float, rise: float = 1.0, over: float = 0.005) -> Callable[[float], float]:
    """The force [N] over the closing [m] of a spring whose stiffness grows `rise` times within `over` [m]."""

    def force(way: float) -> float:
        way = max(0.0, way)
        part = min(way, over)
        growth = 0.5 * (rise - 1.0) * part**2 / over + (rise - 1.0) * (way - part)
        return stiffness * (way + growth)

    return force


@dataclass(kw_only=True)
class Fingers:
    """Fingers about an object of a width [m]."""

    force_at: Callable[[float], float] = field(default_factory=lambda: spring(800.0))
    width: float = 0.025
    terms: Sequence[tuple[float, float]] = RELAXATION
    force: float = 0.0
    _elastic: float = 0.0
    _over: list[float] = field(default_factory=list)

    def step(self, opening: float, dt: float) -> None:
        elastic = self.force_at(self.width - opening)
        self._over = self._over or [0.0] * len(self.terms)
        change, self._elastic = elastic - self._elastic, elastic
        for index, (share, time) in enumerate(self.terms):
            self._over[index] = (self._over[index] + share * change) * math.exp(-dt / time)
        self.force = max(0.0, elastic + sum(self._over)) if elastic > 0.0 else 0.0


@dataclass(kw_only=True)
class Jaws:
    """Jaws that go to a step at a constant speed after a delay, and report every 20 ms an opening to half a count."""

    opening: float = 0.03
    delay: float = 0.025
    state: GripperState | None = None
    blocked_at: float = -1.0
    target: float = math.nan
    speed: float = 0.0
    moves: list[tuple[float, float, float]] = field(default_factory=list)
    _due: list[tuple[float, float, float]] = field(default_factory=list)
    _stamps: list[float] = field(default_factory=list)
    _openings: list[float] = field(default_factory=list)
    _next: float = 0.0

    def __post_init__(self) -> None:
        self.target = self.opening

    def move(self, now: float, opening: float, speed: float) -> None:
        self.moves.append((now, opening, speed))
        self._due.append((now + self.delay, opening, speed))

    def step(self, now: float, dt: float) -> bool:
        while self._due and self._due[0][0] <= now:
            _, self.target, self.speed = self._due.pop(0)
        reach = self.speed * dt
        wanted = self.opening + min(max(self.target - self.opening, -reach), reach)
        self.opening = max(wanted, self.blocked_at)
        if now < self._next:
            return False
        self._next = now + 0.02
        # as the driver reads the byte: the middle between two counts while moving, the target at rest
        reported = self.target if self.opening == self.target else (math.ceil(self.opening / STEP) - 0.5) * STEP
        self._stamps.append(now)
        self._openings.append(reported)
        phase = Phase.READY if self.opening == self.target else Phase.MOVING
        self.state = GripperState(
            phase=phase, stamp=now, opening=reported, target=self.target, calibrated=True, activated=True
        )
        return True

    def opening_at(self, stamp: float) -> float:
        if not self._stamps or not self._stamps[0] <= stamp <= self._stamps[-1]:
            return math.nan
        return float(np.interp(stamp, self._stamps[-60:], self._openings[-60:]))


@dataclass(kw_only=True)
class Camera:
    """Images at 30 Hz whose force arrives late, with noise, and sometimes not at all."""

    latency: float = 0.06
    jitter: float = 0.01
    noise: float = 0.05
    offset: float = 0.0
    missing: float = 0.02
    seed: int = 0
    change: Callable[[ForceSample], ForceSample | None] = lambda sample: sample

    def __post_init__(self) -> None:
        self._random = np.random.default_rng(self.seed)
        self._next = 0.013
        self._count = 0
        self._queue: list[tuple[float, int, ForceSample]] = []

    def step(self, now: float, force: float) -> list[ForceSample]:
        if now >= self._next:
            self._next += 1.0 / 30.0
            # the magnitude of a vector with noise on it, as an estimator states it
            measured = abs(force + self.offset + self.noise * self._random.standard_normal())
            due = now + max(0.005, self.latency + self.jitter * self._random.standard_normal())
            sample = ForceSample(stamp=now, arrived=due, force=measured)
            if self._random.uniform() >= self.missing and (sample := self.change(sample)) is not None:
                self._count += 1
                heapq.heappush(self._queue, (due, self._count, sample))
        ready = []
        while self._queue and self._queue[0][0] <= now:
            ready.append(heapq.heappop(self._queue)[2])
        return ready


@dataclass(kw_only=True)
class Course:
    """What a grasp did, sample by sample of its status."""

    times: list[float] = field(default_factory=list)
    forces: list[float] = field(default_factory=list)
    openings: list[float] = field(default_factory=list)
    statuses: list[GraspStatus] = field(default_factory=list)
    stops: list[float] = field(default_factory=list)
    moves: list[tuple[float, float, float]] = field(default_factory=list)

    @property
    def status(self) -> GraspStatus:
        return self.statuses[-1]

    @property
    def peak(self) -> float:
        return max(self.forces)

    def overshoot(self, force: float) -> float:
        return self.peak - force

    def held_after(self) -> float:
        """Time of the first holding status [s]; NaN without."""
        return next(
            (t for t, s in zip(self.times, self.statuses, strict=True) if s.phase is GraspPhase.HOLDING), math.nan
        )

    def onset_at(self) -> float:
        """Time of the first 0.02 N [s]."""
        return next((t for t, f in zip(self.times, self.forces, strict=True) if f > 0.02), math.nan)

    def steady_error(self, force: float, seconds: float = 5.0) -> float:
        """Mean of force minus set force over the last seconds [N]."""
        end = self.times[-1]
        return float(np.mean([f - force for t, f in zip(self.times, self.forces, strict=True) if t > end - seconds]))


@dataclass(kw_only=True)
class Bench:
    """All of it in stepped time; `on_step` may do anything to it at any time."""

    goal: GraspGoal
    settings: GraspSettings = field(default_factory=GraspSettings)
    fingers: Fingers = field(default_factory=Fingers)
    jaws: Jaws = field(default_factory=Jaws)
    camera: Camera = field(default_factory=Camera)
    touch_delay: float | None = None  # [s] of `touching` behind the contact; None: nobody says it
    on_step: Callable[[Bench, float], None] = lambda bench, now: None
    change_state: Callable[[GripperState, float], GripperState] = lambda state, now: state

    def __post_init__(self) -> None:
        self.grasp = ForceGrasp(self.goal, self.settings, resolution=STEP)

    def run(self, seconds: float) -> Course:
        course, now, touched = Course(), 0.0, math.inf
        for _ in range(round(seconds / DT)):
            now += DT
            replied = self.jaws.step(now, DT)
            self.fingers.step(self.jaws.opening, DT)
            touched = min(touched, now) if self.fingers.force > 0.0 else math.inf
            self.on_step(self, now)
            arrived = self.camera.step(now, self.fingers.force)
            for sample in arrived:
                self.grasp.take_force(sample)
                if self.touch_delay is not None:
                    self.grasp.take_touch(sample.stamp > touched + self.touch_delay, sample.stamp)
            if (replied or arrived) and self.jaws.state is not None:
                self._update(now, course)
        course.moves = self.jaws.moves
        return course

    def _update(self, now: float, course: Course) -> None:
        state = self.change_state(replace(self.jaws.state), now)
        ended = self.grasp.phase is GraspPhase.STOPPED
        move = self.grasp.update(state, now, self.jaws.opening_at)
        if move is not None:
            self.jaws.move(now, move.opening, move.speed)
        usable = state.phase in (Phase.READY, Phase.MOVING) and not state.estopped
        if self.grasp.phase is GraspPhase.STOPPED and not ended and move is None and usable:
            course.stops.append(now)
            self.jaws.move(now, math.floor(self.jaws.opening / STEP + 0.5) * STEP, 0.02)
        course.times.append(now)
        course.forces.append(self.fingers.force)
        course.openings.append(self.jaws.opening)
        course.statuses.append(self.grasp.status(state, now))
