"""Hold 2 N on the emulated gripper without ROS; needs `python -m finforce_sim.emulator --link /tmp/ssg48`."""

from collections import deque
from threading import Event, Thread

from finforce_driver.can import build_bus
from finforce_driver.grasp.force_monitor import ForceSample
from finforce_driver.grasp.session import hold_force
from finforce_driver.gripper import Gripper
from finforce_driver.settings import GraspGoal
from finforce_driver.state import Phase


def watch(gripper: Gripper, forces: deque, ended: Event) -> None:
    """Simulate a camera: at 30 Hz, the force of a spring of 25 mm and 0.3 N/mm, 50 ms late."""
    while not ended.wait(1 / 30):
        now = gripper.clock.now()
        opening = gripper.opening_at(now - 0.05)
        forces.append(ForceSample(stamp=now - 0.05, arrived=now, force=300.0 * max(0.0, 0.025 - opening)))


with Gripper(build_bus("/tmp/ssg48")) as gripper:
    state = gripper.wait(lambda state: state.phase not in (Phase.DISCONNECTED, Phase.PROBING), 3.0)
    if state.phase is Phase.UNCALIBRATED:
        gripper.calibrate()  # the jaws open and close fully
        gripper.wait(lambda state: state.phase is not Phase.CALIBRATING, 40.0)
    gripper.move(0.030, speed=0.1)
    gripper.wait(lambda state: state.phase is not Phase.MOVING, 10.0)
    forces, ended = deque(), Event()
    Thread(target=watch, args=(gripper, forces, ended)).start()
    try:
        # called again and again for the forces that have come meanwhile
        status = hold_force(
            gripper, lambda: [forces.popleft() for _ in range(len(forces))], GraspGoal(force=2.0, speed=0.004)
        )
        print(f"{status.phase.value}: {status.force:.2f} N at {1e3 * gripper.state.opening:.2f} mm")
    finally:
        ended.set()
    gripper.move(0.048)
    print(gripper.wait(lambda state: state.phase is not Phase.MOVING, 10.0).message)
