"""Claims about ports that cannot be opened: one line each, with what would help."""

import errno

import pytest
import serial
from serial.tools.list_ports_common import ListPortInfo

from finforce_driver.can.slcan import SerialBus, explain_refusal
from finforce_driver.errors import LinkError


def test_an_absent_port_names_those_that_exist(monkeypatch, tmp_path):
    found = [ListPortInfo(f"/dev/ttyACM{number}", skip_link_detection=True) for number in (8, 7)]
    found[1].description = "CANable"
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: found)
    with pytest.raises(
        LinkError,
        match=r"there is no port .*ttyACM0.*/dev/ttyACM7 \(CANable\), /dev/ttyACM8; is the adapter plugged in",
    ):
        SerialBus(str(tmp_path / "ttyACM0")).open()


def test_an_absent_port_among_none_says_so(monkeypatch, tmp_path):
    monkeypatch.setattr("serial.tools.list_ports.comports", list)
    with pytest.raises(LinkError, match=r"ports here: none; is the adapter plugged in\?$"):
        SerialBus(str(tmp_path / "ttyACM0")).open()
    with pytest.raises(LinkError, match="there is no port 'can0'.*can0, needs the interface socketcan"):
        SerialBus("can0").open()


def test_a_port_without_permission_names_the_group(monkeypatch):
    refusal = serial.SerialException(errno.EACCES, "could not open port: Permission denied")
    monkeypatch.setattr(serial, "Serial", lambda *_, **__: (_ for _ in ()).throw(refusal))
    with pytest.raises(LinkError, match="no permission to open /dev/ttyACM0.*dialout"):
        SerialBus("/dev/ttyACM0").open()


@pytest.mark.parametrize("path", ["/dev/null", "/"])
def test_what_is_no_serial_port_is_refused(path):
    with pytest.raises(LinkError, match="is not a serial port"):
        SerialBus(path).open()


@pytest.mark.parametrize("number", [errno.ENOENT, errno.EBUSY, errno.EAGAIN, errno.EACCES, errno.EIO, None])
def test_every_refusal_is_one_line(number):
    text = explain_refusal("/dev/ttyACM0", 115_200, OSError(number, "because") if number else ValueError("because"))
    assert "/dev/ttyACM0" in text
    assert "\n" not in text
