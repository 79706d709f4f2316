"""The emulated port in real time; bounded waits, no claim on how long anything takes."""

import os
import signal
import subprocess
import sys
import termios
import time
from pathlib import Path

import pytest
import serial
from process_fakes import running

from finforce_driver.errors import LinkError
from finforce_sim.emulator.__main__ import build_adapter, build_parser, main
from finforce_sim.emulator.adapter import EmulatedAdapter
from finforce_sim.emulator.firmware import EmulatedGripper
from finforce_sim.emulator.pty_port import PtyPort

REPLY = b"t078400000030\r"
POLL = b"t07A0\r"
PATIENCE = 5.0  # [s] for what takes milliseconds on an idle machine


def make_adapter() -> EmulatedAdapter:
    return EmulatedAdapter(EmulatedGripper(), latency=0.0)


def open_serial(port, baud_rate=115200) -> serial.Serial:
    return serial.Serial(str(getattr(port, "path", port)), baud_rate, timeout=PATIENCE, exclusive=True)


def ask(device, line=POLL) -> bytes:
    device.write(line)
    return device.read_until(b"\r")


def wait_for(condition) -> bool:
    end = time.monotonic() + PATIENCE
    while not condition() and time.monotonic() < end:
        time.sleep(0.005)
    return condition()


@pytest.fixture
def link(tmp_path):
    return tmp_path / "deep" / "gripper"


def test_port_answers_and_comes_back_for_another_program(link):
    with PtyPort(make_adapter(), link) as port:
        assert port.path == str(link)
        for _ in range(2):
            with open_serial(port) as device:
                device.write(b"C\rS8\rO\r")
                assert [ask(device) for _ in range(20)] == [REPLY] * 20
    assert not os.path.lexists(link)


def test_without_a_link_the_port_has_its_own_name():
    with PtyPort(make_adapter()) as port:
        assert Path(port.path).exists()
    assert port.path == ""
    port.close()


def test_time_passes_by_itself():
    adapter = make_adapter()
    with PtyPort(adapter):
        assert wait_for(lambda: adapter.gripper.now > 0.05)
    after = adapter.gripper.now
    time.sleep(0.02)
    assert adapter.gripper.now == after


def test_closing_is_an_error_for_who_has_it_open_and_opening_restores_the_link(link):
    with PtyPort(make_adapter(), link) as port:
        device = open_serial(port)
        device.write(b"S8\rO\r")
        assert ask(device) == REPLY
        port.close()
        assert not os.path.lexists(link)
        with pytest.raises((OSError, termios.error)):
            device.write(POLL)
            device.read(1)
            raise AssertionError("the port should be gone")
        device.close()
        port.close()
        port.open()
        with open_serial(port) as device:
            device.write(b"S8\rO\r")
            assert ask(device) == REPLY


def test_a_file_in_place_of_the_link_is_not_overwritten(tmp_path):
    path = tmp_path / "precious"
    path.write_text("data")
    with pytest.raises(LinkError, match="precious"), PtyPort(make_adapter(), path):
        pass
    assert path.read_text() == "data"
    assert main(["--link", str(path)]) == 2


def test_a_host_that_never_reads_does_not_block_the_port():
    with PtyPort(make_adapter()) as port, open_serial(port) as device:
        device.write(b"S8\rO\r")
        for _ in range(1000):
            device.write(POLL * 2)
        before = port.adapter.gripper.now
        assert wait_for(lambda: port.adapter.gripper.now > before + 0.05)


def test_command_line_describes_the_gripper():
    options = build_parser().parse_args(
        [
            "--variant",
            "old",
            "--node",
            "3",
            "--object-mm",
            "25",
            "--stiffness",
            "0.8",
            "--ack",
            "lawicel",
        ]
    )
    adapter = build_adapter(options)
    gripper = adapter.gripper
    assert (gripper.variant, gripper.node_id, gripper.jaws.object_opening) == ("old", 3, None)
    assert gripper.jaws.load(0.024) == pytest.approx(0.8) and gripper.jaws.load(0.026) == 0.0
    rigid = build_adapter(build_parser().parse_args(["--object-mm", "25"]))
    assert rigid.gripper.jaws.object_opening == 0.025 and rigid.gripper.jaws.load is None


def test_impossible_node_ends_with_one_line(capsys):
    assert main(["--node", "16"]) == 2
    assert capsys.readouterr().err == "node_id: got 16, expected 0 to 15\n"


@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGINT])
def test_program_says_its_path_and_ends_cleanly(link, end):
    command = [sys.executable, "-m", "finforce_sim.emulator", "--link", str(link)]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    with running(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout.readline().strip() == str(link)
        with open_serial(link) as device:
            device.write(b"S8\rO\r")
            assert ask(device) == REPLY
        process.send_signal(end)
        assert process.wait(PATIENCE) == 0
    assert not os.path.lexists(link)


def test_a_signal_while_the_program_is_loaded_ends_it_without_a_word():
    code = """
import os, runpy, signal, sys
class Hook:
    def find_spec(self, name, *_):
        if name == "finforce_sim.emulator.adapter":
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Hook())
runpy.run_module("finforce_sim.emulator", run_name="__main__")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
