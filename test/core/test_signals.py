"""Claims about the end by a signal: whenever it comes, the program ends, and nothing waits for itself."""

import os
import random
import signal
import subprocess
import sys
import threading
import time

import pytest
from process_fakes import running

from finforce.signals import STOPS, StopSignals

PROGRAM = """
from finforce.signals import StopSignals
with StopSignals() as stop:
    print("ready", flush=True)
    while not stop.wait(0.0):
        pass
"""
PATIENCE = 30.0  # [s] for what takes milliseconds on an idle machine


@pytest.mark.parametrize("number", STOPS)
def test_signal_ends_the_wait_and_the_handlers_of_before_return(number):
    before = signal.getsignal(number)
    with StopSignals() as stop:
        assert not stop.wait(0.0)
        os.kill(os.getpid(), number)
        assert stop.wait() and stop.wait(0.0)
    assert signal.getsignal(number) is before
    assert signal.set_wakeup_fd(-1) == -1


def test_signal_from_another_thread_ends_a_wait_without_end():
    with StopSignals() as stop:
        timer = threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGTERM))
        timer.start()
        assert stop.wait()
        timer.join()


def test_signal_at_any_moment_ends_the_wait():
    moments = random.Random(0)
    for _ in range(500):
        with StopSignals() as stop:
            timer = threading.Timer(1e-3 * moments.random(), os.kill, (os.getpid(), signal.SIGTERM))
            timer.start()
            end = time.monotonic() + PATIENCE
            while not stop.wait(0.0):
                assert time.monotonic() < end
            timer.join()


def test_signal_at_any_moment_ends_a_process_cleanly():
    moments = random.Random(1)
    for _ in range(5):
        with running([sys.executable, "-c", PROGRAM], stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout.readline() == "ready\n"
            time.sleep(1e-3 * moments.random())
            process.send_signal(signal.SIGTERM)
            assert process.wait(PATIENCE) == 0
