"""Claims about how the solver tiers are measured, scored and compared."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from finforce_ifea.settings import SOLVERS
from lab.bench import solvers as bench
from lab.bench.solvers import (
    QUICK_RADIUS,
    Run,
    Tier,
    bench_finger,
    list_tiers,
    load_cases,
    record_press,
    run_tier,
    score_shapes,
    tier_row,
)

JAW = bench_finger()
PRESSES = [record_press(case, JAW) for case in load_cases() if case.radius == QUICK_RADIUS]


def perfect(press, factor=1.0):
    return Run(press=press, force=factor * press.force, seconds=np.full(9, 1e-3), cpu=np.full(9, 1e-3))


def test_every_registered_solver_is_a_tier_and_the_slow_one_can_be_left_out():
    # the bench finger is a drawing, which solver plane does not describe
    assert {tier.solver for tier in list_tiers()} == set(SOLVERS) - {"default", "plane"}
    assert {tier.name for tier in list_tiers()} - {tier.name for tier in list_tiers(slow=False)} == {"solid, fine mesh"}


def test_only_solved_steps_are_timed_and_untrusted_forces_are_none(monkeypatch):
    class Estimator:
        def __init__(self, *_, **__):
            self.reset()

        def reset(self):
            self.steps = 0

        def warm_up(self):
            pass

        def update(self, observation, contact):
            self.steps += 1
            status = ("ok", "unloaded", "unobservable", "waiting")[self.steps % 4]
            return SimpleNamespace(status=status, trusted=status in ("ok", "unloaded"), force=np.ones(3))

    monkeypatch.setattr(bench, "ForceEstimator", Estimator)
    run = run_tier(bench.TIERS[0], JAW, PRESSES[:1])[0]
    frames = len(PRESSES[0].observations)
    assert len(run.seconds) == len(run.cpu) == frames // 4
    assert np.isnan(run.force[:, 0]).sum() == pytest.approx(frames / 2, abs=1)


def test_frame_finds_the_forces_of_the_independent_program():
    tier = Tier(name="frame", solver="frame")
    runs = run_tier(tier, JAW, PRESSES[1:2])
    row, shapes = tier_row(tier, "noise-free", runs, 1.0), score_shapes(runs)
    # within 3 % of the largest force, 4 N, which is what the frame's verification allows at these heights
    assert row["RMSE/N"] < 0.12 and row["answered/%"] == 100.0
    assert shapes["solved"] == shapes["shapes"] == 5


def test_shape_errors_tell_a_wrong_modulus_from_a_wrong_shape():
    runs = [perfect(press, factor) for press, factor in zip(PRESSES, (2.0, 4.0, 8.0), strict=True)]
    errors = score_shapes(runs)
    assert errors["nothing fitted/N"] > 0.1
    assert errors["a factor per height/N"] == pytest.approx(0.0, abs=1e-9)


def test_unanswered_frames_are_counted_and_in_no_error():
    run, tier = perfect(PRESSES[0]), Tier(name="t", solver="frame")
    force = run.force.copy()
    force[np.flatnonzero(PRESSES[0].held)[:15]] = np.nan
    row = tier_row(tier, "noisy", [replace(run, force=force)], 1.0)
    assert row["answered/%"] == pytest.approx(90.0) and row["RMSE/N"] == 0.0
    assert tier_row(tier, "noisy", [replace(run, force=force + [1.0, 0.0, 0.0])], 1.0)["RMSE/N"] > 0.5


def test_peer_is_compared_on_this_machine_and_on_its_own():
    compared = bench.compare_with_sofa({"SuperLU/ms": 6.0, "step p50/ms": 1.3, "CPU p50/ms": 1.3})
    assert compared["rate in SOFA's"] == pytest.approx(3.0)
    assert compared["by the yardstick"] == pytest.approx(6.0)  # a yardstick of 6 ms for the peer's 3 ms


def test_tier_that_does_not_exist_is_noted_and_the_others_are_measured(monkeypatch):
    slow = Tier(name="slow", solver="frame", slow=True)
    tiers = (Tier(name="nothing", solver="nothing"), Tier(name="frame", solver="frame", contact="outline"), slow)
    monkeypatch.setattr(bench, "list_tiers", lambda slow: tiers)
    monkeypatch.setattr(bench, "load_cases", lambda: (PRESSES[1].case,))
    monkeypatch.setattr(bench, "time_factorisation", lambda: [3e-3])

    def run(tier, jaw, presses, progress):
        tier.settings()
        return [perfect(press) for press in presses]

    monkeypatch.setattr(bench, "run_tier", run)
    figures = bench.measure(True)
    assert figures.tables["tiers"][["tier", "key points"]].to_numpy().tolist() == [
        ["frame", "noise-free"],
        ["frame", "noisy"],
        ["slow", "noisy"],
    ]
    assert figures.tables["shapes"]["tier"].tolist() == ["frame", "SOFA, quoted"]
    assert figures.notes[0].startswith("nothing: not measured: solver: got 'nothing'")
    assert figures.tables["tiers"]["RMSE/N"].max() == 0.0


def test_the_front_has_what_nothing_is_faster_and_better_than_and_leaves_out_what_hardly_answers(tmp_path):
    rows = [
        ("lookup", 0.1, 0.3, 95.0),
        ("slow", 2.0, 0.2, 95.0),
        ("worse", 1.0, 0.4, 95.0),
        ("seldom", 0.01, 0.1, 20.0),
    ]
    tiers = pd.DataFrame(rows, columns=["tier", "step p50/ms", "RMSE/N", "answered/%"])
    assert bench.find_front(tiers)["tier"].tolist() == ["lookup", "slow"]
    bench.draw_tiers(tiers.assign(**{"key points": "noisy"}), tmp_path / "tiers.png")
    assert (tmp_path / "tiers.png").stat().st_size
