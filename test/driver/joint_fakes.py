"""An emulated joint as the servos of other grippers are: late, in steps, at its own speed, seen now and then."""

import math
from collections import deque

from finforce_driver.joint import JointGripper
from finforce_driver.settings import GripperSettings, JointSettings
from finforce_sim.emulator.virtual import VirtualClock

# As their makers and drivers have them: 85 mm and 0.8 rad in 255 steps, polled at 100 Hz; 70 mm and 1.7 rad in steps
# of 1.5 mrad, at 30 Hz, late, and without a speed.
ROBOTIQ = {
    "stroke": 0.085,
    "closed": 0.8,
    "open": 0.0,
    "step": 0.8 / 255,
    "period": 0.01,
    "latency": 0.03,
    "speed": 1.3,
}
LEROBOT = {"stroke": 0.070, "closed": 0.0, "open": 1.7, "step": 1.5e-3, "period": 1 / 30, "latency": 0.08, "speed": 3.0}


class EmulatedJoint:
    """A servo in stepped time behind a `JointGripper`."""

    def __init__(self, *, stroke, closed, open, step, period, latency, speed, rate=25.0, takes_speed=False, load=None):
        self.clock = VirtualClock()
        resolution = step * stroke / abs(open - closed)
        self.joint = JointSettings(closed=closed, open=open, resolution=resolution, rate=0.0 if takes_speed else rate)
        self.settings = GripperSettings(stroke=stroke, closed_opening=0.0)
        self.gripper = JointGripper(self.receive, self.settings, self.joint, self.clock)
        self.step_size, self.period, self.latency, self.speed = step, period, latency, speed
        self.takes_speed, self.load = takes_speed, load
        self.value = self.target = open
        self.pace = speed
        self.blocked_at = -math.inf  # opening [m]
        self.answers = True
        self._due = deque()
        self._next = 0.0
        self.commands = []
        self.clock.attach(self)

    @property
    def opening(self):
        return self.opening_of(self.value)

    def opening_of(self, value):
        return (value - self.joint.closed) * self.settings.stroke / (self.joint.open - self.joint.closed)

    def receive(self, position, velocity, effort):
        self.commands.append((position, velocity, effort))
        self._due.append((self.clock.now() + self.latency, position, velocity))

    def step(self, dt):
        now = self.clock.now()
        while self._due and self._due[0][0] <= now:
            _, position, velocity = self._due.popleft()
            self.target = round(position / self.step_size) * self.step_size
            self.pace = min(self.speed, velocity) if self.takes_speed and velocity > 0 else self.speed
        way = min(max(self.target - self.value, -self.pace * dt), self.pace * dt)
        if self.opening_of(self.value + way) >= self.blocked_at or self.opening_of(self.value + way) > self.opening:
            self.value += way
        if now >= self._next and self.answers:
            self._next = now + self.period
            self.gripper.take(round(self.value / self.step_size) * self.step_size, now)
        self.gripper.tick()
