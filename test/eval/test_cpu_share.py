"""CPU use of processes is what the kernel says of them, between two samples."""

import math
import os
import subprocess
import sys
from time import perf_counter

import pytest

from finforce_eval.replay.processes import TICKS, CpuMeter, busy_seconds, cpu_seconds


class FakeProcesses:
    """A clock and the CPU times of processes, set by hand."""

    def __init__(self, **seconds):
        self.time = 100.0
        self.seconds = seconds

    def meter(self) -> CpuMeter:
        names = list(self.seconds)
        return CpuMeter(
            {name: index for index, name in enumerate(names)},
            clock=lambda: self.time,
            read=lambda pid: self.seconds[names[pid]],
        )


def test_share_is_the_cpu_time_between_first_and_last_sample_by_the_time_between_them():
    fake = FakeProcesses(solver=3.0, idle=7.0)
    meter = fake.meter()
    meter.sample()
    fake.time, fake.seconds["solver"] = 105.0, 3.5
    meter.sample()
    fake.time, fake.seconds["solver"] = 110.0, 8.0
    meter.sample()
    assert meter.shares() == {"solver": pytest.approx(50.0), "idle": 0.0}
    assert meter.used() == {"solver": pytest.approx(5.0), "idle": 0.0}
    assert meter.elapsed == 10.0


def test_restart_forgets_what_was_used_before():
    fake = FakeProcesses(solver=0.0)
    meter = fake.meter()
    meter.sample()
    fake.time, fake.seconds["solver"] = 110.0, 10.0
    meter.restart()
    fake.time = 111.0
    meter.sample()
    assert meter.shares() == {"solver": 0.0}


@pytest.mark.parametrize("samples", [0, 1])
def test_without_two_samples_nothing_is_known(samples):
    meter = FakeProcesses(solver=1.0).meter()
    for _ in range(samples):
        meter.sample()
    assert math.isnan(meter.shares()["solver"])


def test_process_that_has_gone_has_no_share():
    fake = FakeProcesses(solver=1.0)
    meter = fake.meter()
    meter.sample()
    fake.time, fake.seconds["solver"] = 101.0, None
    meter.sample()
    assert math.isnan(meter.shares()["solver"])


def test_stat_is_read_past_a_name_with_spaces_and_parentheses(tmp_path):
    (tmp_path / "7").mkdir()
    rest = " ".join(["S", *"0" * 10, "250", "150", *"0" * 37])
    (tmp_path / "7" / "stat").write_text(f"7 (a ) S 9 9) {rest}")
    assert cpu_seconds(7, tmp_path) == pytest.approx(400 / TICKS)


def test_process_that_ended_has_no_cpu_time():
    child = subprocess.Popen([sys.executable, "-c", ""])
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
    assert cpu_seconds(child.pid) is None  # a zombie
    child.wait()
    assert cpu_seconds(child.pid) is None


def test_own_work_is_counted():
    before, begin = cpu_seconds(), perf_counter()
    while cpu_seconds() - before < 0.05:
        assert perf_counter() - begin < 30.0, "no CPU time was counted in 30 s of work"
    assert cpu_seconds() > before


def test_busy_time_leaves_out_idling_and_waiting_for_disks(tmp_path):
    (tmp_path / "stat").write_text("cpu  100 20 30 9999 8888 4 5 1 77 0\ncpu0 1 2 3\n")
    assert busy_seconds(tmp_path) == pytest.approx(160 / TICKS)
