"""A driver node on an emulated gripper behind a port, soft fingers between its jaws, and a camera for their force."""

from driver_node_fakes import call, start_driver, wrench
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from finforce_driver.emulator.adapter import EmulatedAdapter
from finforce_driver.emulator.firmware import EmulatedGripper
from finforce_driver.emulator.pty_port import PtyPort

# a machine that is busy with other things stops the emulation for a while, too
PATIENT = {"gripper.reply_timeout": 0.5, "grasp.stale_after": 1.0, "max_age": 1.0, "grasp.silence_timeout": 10.0}


class Bench:
    """An emulated gripper, its port, the driver node on it, and a probe that listens to both."""

    def __init__(self, probe, variant="new", *, calibrated=True, open_port=True, baud_rate=None, **parameters):
        self.probe = probe
        self.gripper = EmulatedGripper(variant)
        self.gripper.calibrated = calibrated
        self.port = PtyPort(EmulatedAdapter(self.gripper), baud_rate=baud_rate)
        if open_port:
            self.port.open()
        port = self.port.path or "/dev/no_such_port"
        self.node = start_driver(probe, **{"port": port, **PATIENT, **parameters})
        self.joints = probe.got["joint_states"]
        self.command = probe.speak("/gripper_driver/command", JointState)
        probe.connected(self.command)

    def close(self):
        self.node.destroy_node()
        self.port.close()

    def call(self, name, kind=Trigger, request=None, patience=10.0):
        return call(self.probe, kind, name, request, patience)

    def wait_for_joints(self, count=1):
        """Wait for new joint states."""
        have = len(self.joints)
        self.probe.wait_for(lambda: len(self.joints) >= have + count)

    def move(self, opening, **fields):
        self.command.publish(JointState(position=[opening], **fields))

    def diagnosis(self, level, word):
        found = []

        def matches():
            states = [s for array in self.probe.got["/diagnostics"][-3:] for s in array.status]
            found[:] = [s for s in states if s.level[0] == level and word in s.message]
            return bool(found)

        self.probe.wait_for(matches)
        return found[-1]


class Fingers:
    """Soft fingers on an object, and the camera that sees their force 30 times a second."""

    STIFFNESS, TOUCH = 800.0, 0.0465  # N per m of opening; m

    def __init__(self, bench):
        self.bench = bench
        bench.gripper.jaws.load = self.force
        self.out = bench.probe.speak("grasp_wrench", WrenchStamped)
        bench.probe.connected(self.out)
        self.timer = bench.probe.create_timer(1.0 / 30.0, lambda: self.out.publish(wrench(self.present)))

    def force(self, opening):
        return self.STIFFNESS * max(0.0, self.TOUCH - opening)

    @property
    def present(self):
        return self.force(self.bench.gripper.true_opening)
