"""The gripper's CAN link: messages to the bit, SLCAN, python-can, and the bus that an interface's name stands for."""

from finforce_driver.can.protocol import Bus
from finforce_driver.can.python_can import PythonCanBus
from finforce_driver.can.slcan import SerialBus


def build_bus(port: str, interface: str = "slcan", *, baud_rate: int = 115_200) -> Bus:
    """Return a bus of 1 Mbit/s that is not yet open.

    Args:
        port: path of the serial port of the adapter for "slcan", else the channel of python-can, such as "can0".
        interface: "slcan", or an interface of python-can: "socketcan", "gs_usb", "virtual", ...
        baud_rate: of the serial port [baud].
    """
    return SerialBus(port, baud_rate) if interface == "slcan" else PythonCanBus(interface, port)
