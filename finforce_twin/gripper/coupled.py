"""An emulated gripper at a serial port whose jaws are those of the twin."""

from __future__ import annotations

from finforce_driver.emulator.adapter import EmulatedAdapter
from finforce_driver.emulator.firmware import EmulatedGripper
from finforce_driver.emulator.pty_port import PtyPort
from finforce_twin.gripper.pressing import PressedGrasp


class CoupledGripper:
    """A gripper that any driver can open by a link, and that closes on the object of a grasp.

    Args:
        grasp: what its jaws press on, before anything relaxes.
        link: path of a symbolic link to the port; empty: none, the port has a name of its own.
        variant: of the firmware, "new" or "old".
    """

    def __init__(self, grasp: PressedGrasp, link: str, variant: str = "new") -> None:
        self.gripper = EmulatedGripper(variant, load=grasp.elastic_force)
        self._port = PtyPort(EmulatedAdapter(self.gripper), link or None)

    @property
    def opening(self) -> float:
        """The true opening between the undeformed inner faces [m]."""
        return self.gripper.jaws.opening

    @property
    def path(self) -> str:
        """What a driver opens."""
        return self._port.path

    def open(self) -> None:
        """Make the port and start the gripper.

        Raises:
            LinkError: something that is no link lies where the link should be.
        """
        self._port.open()

    def close(self) -> None:
        """Stop the gripper and remove the port; may be called again."""
        self._port.close()
