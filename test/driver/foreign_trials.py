"""One gripper with an elastic object, one thing that its driver did not order, and the emulator's truth as the judge.

Drawn from a seed: firmware, adapter, object, what the driver was doing, what happens and when. `run_many` counts the
complaints of as many trials as are asked for: `PYTHONPATH=test/core python test/driver/foreign_trials.py 1000`.
"""

import sys
from collections import Counter
from random import Random

from emulator_fakes import VARIANTS, Rig

from finforce_driver.can.protocol import CanMessage
from finforce_driver.errors import DriverError, GripperTimeoutError
from finforce_driver.state import MoveOutcome, Phase
from finforce_sim.emulator.control import Mode

LIMIT = 8.0  # [N]
LATENCIES = (0.0003, 0.001, 0.003, 0.012)  # [s]
WATCHED = 6.0  # [s]; a calibration takes 3 s at most
OFF, TOLERANCE = 6e-4, 0.8e-3  # [m] of openings at rest, and of those that are told while the jaws move
ASLEEP = 0.3  # [s] that a gripper may take to be known limp

EVENTS = ("calibrate", "calibrate", "move", "move", "release", "idle", "clear", "poll to calibrate", "poll", "order")
STARTS = ("holding", "holding", "moving", "limp")


class Trial:
    """One trial; `complaints` says what was wrong."""

    def __init__(self, seed):
        self.draw = draw = Random(seed)
        self.complaints = set()
        self.event, self.start = draw.choice(EVENTS), draw.choice(STARTS)
        self.seen = draw.random() < 0.5
        self.rig = Rig(draw.choice(VARIANTS), latency=draw.choice(LATENCIES), poll_rate=draw.choice((50.0, 100.0)))
        self.width, self.stiffness = draw.uniform(0.01, 0.04), draw.uniform(300.0, 1300.0)
        self.happened = False
        self.forces, self.last, self.limp_since, self.still_at = [], None, None, 0.0

    def play(self):
        """Play it, and return the complaints."""
        rig, draw = self.rig, self.draw
        rig.arrive(min(0.047, self.width + 0.003))
        rig.emulated.jaws.load = lambda opening: self.stiffness * max(0.0, self.width - opening)
        rig.clock.attach(self)
        self._begin()
        rig.gripper.listen(self._check)
        rig.live(draw.uniform(0.0, 0.5))
        self._happen()
        rig.live(WATCHED)
        self._check_end()
        return self.complaints

    def step(self, dt):
        """Look at the truth, every millisecond."""
        jaws, now = self.rig.emulated.jaws, self.rig.clock.now()
        self.forces.append(jaws.force)
        if jaws.force > LIMIT:
            self.complaints.add("over 8 N")
        if self.last is None or abs(jaws.opening - self.last[1]) > 2e-4:
            self.last, self.moved_at = (now, jaws.opening), now
        asleep = self.rig.emulated.mode is Mode.IDLE
        self.limp_since = (self.limp_since or now) if asleep else None

    def _begin(self):
        """Bring the driver to what it does when it happens."""
        rig, draw = self.rig, self.draw
        if self.start == "holding":
            rig.arrive(self.width - draw.uniform(1.0, 3.0) / self.stiffness, 0.01, 7.5)
        elif self.start == "moving":
            self.goal = draw.choice((0.047, self.width - 2.0 / self.stiffness))
            rig.gripper.move(self.goal, draw.choice((0.002, 0.004, 0.02)), 7.5)
        else:
            rig.gripper.release_power()
        rig.live(0.3)

    def _happen(self):
        """Let the unordered thing happen."""
        rig, draw = self.rig, self.draw
        self.happened = True
        order = bytes([draw.randrange(256), draw.randrange(10, 51), 0x01, draw.randrange(256), 0xC0])
        told = {
            "calibrate": CanMessage(id=0x07C),
            "move": CanMessage(id=0x07A, data=order),
            "release": CanMessage(id=0x07A, data=order[:4] + b"\x00"),
            "idle": CanMessage(id=0x018),
            "clear": CanMessage(id=0x002),
        }.get(self.event)
        if told is not None and self.seen:
            rig.adapter.put_on_bus(told)
        elif told is not None:
            rig.emulated.handle(told)
        else:
            self._corrupt()
            if self.event == "order":
                rig.gripper.wait(lambda state: state.phase is not Phase.PROBING, 1.0)
                self._order_anew()

    def _order_anew(self):
        """Have the driver send an order, which is spoiled."""
        step = self.draw.choice((-2e-4, 2e-4, 1e-3))
        try:
            self.rig.gripper.move(min(0.047, self.rig.emulated.jaws.opening + step), 0.006, 7.5)
        except DriverError:
            self.complaints.add("refused")

    def _corrupt(self):
        """Spoil one byte of the next poll, or of the next order."""
        adapter, draw, write = self.rig.adapter, self.draw, self.rig.adapter.write

        def spoil(data):
            if (data == b"t07A0\r") if self.event.startswith("poll") else data.startswith(b"t07A5"):
                adapter.write = write
                if self.event == "poll to calibrate":
                    data = b"t07C0\r"
                else:
                    place = draw.randrange(1, len(data) - 1)
                    data = data[:place] + bytes([draw.choice(b"0123456789ABCDEFG\xff")]) + data[place + 1 :]
            write(data)

        adapter.write = spoil

    def _check(self, state):
        """Compare a state with the truth."""
        emulated, now = self.rig.emulated, self.rig.clock.now()
        jaws = emulated.jaws
        if state.phase not in (Phase.READY, Phase.MOVING):
            return
        resting = now - self.moved_at > 0.15
        if resting and now - state.stamp < 0.1 and abs(state.opening - jaws.opening) > OFF:
            self.complaints.add("wrong opening")
        if not resting and state.phase is Phase.READY and state.outcome in (MoveOutcome.REACHED, MoveOutcome.GRASPED):
            self.still_at = self.still_at or now
            if now - self.still_at > 0.25:
                self.complaints.add("ready while the jaws move")
        else:
            self.still_at = 0.0
        limp = self.limp_since is not None and now - self.limp_since > ASLEEP
        if limp and (state.outcome is MoveOutcome.GRASPED or state.contact):
            self.complaints.add("grasped with the power stage asleep")

    def _check_end(self):
        """See where a move to 30 mm ends, if it is accepted."""
        rig = self.rig
        if rig.state.phase is Phase.READY and abs(rig.state.opening - rig.emulated.jaws.opening) > OFF:
            self.complaints.add("wrong opening")
        try:
            rig.gripper.move(0.045, 0.05, 7.5)
            state = rig.gripper.wait(lambda state: state.phase is not Phase.MOVING, 10.0)
        except GripperTimeoutError:
            self.complaints.add("no end")
        except DriverError:
            return
        else:
            if state.outcome is MoveOutcome.REACHED and abs(rig.emulated.jaws.opening - 0.045) > OFF:
                self.complaints.add("wrong opening")


def run_many(count, first=0):
    """Return complaints, the seeds that have any, by event, and how the trials ended."""
    found, by_event, wrong, ends, peak = Counter(), Counter(), [], Counter(), 0.0
    for seed in range(first, first + count):
        trial = Trial(seed)
        complaints = trial.play()
        found.update(complaints)
        ends[trial.event, trial.rig.state.phase.value] += 1
        peak = max(peak, max(trial.forces))
        if complaints:
            wrong.append(seed)
            by_event.update((trial.event, trial.seen, complaint) for complaint in complaints)
    return found, by_event, wrong, ends, peak


if __name__ == "__main__":
    count, first = int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0
    found, by_event, wrong, ends, peak = run_many(count, first)
    print(dict(found), f"{len(wrong)} of {count}, peak {peak:.2f} N")
    print(*(f"{key} {number}" for key, number in sorted(by_event.items())), sep="\n")
    print("seeds", wrong[:40])
    print(*(f"{key} {number}" for key, number in sorted(ends.items())), sep="\n")
