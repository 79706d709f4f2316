"""Claims about how the solver tiers are measured, scored, drawn and compared."""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from eval_fakes import drawn_hues

from finforce_eval.errors import OptionError
from finforce_eval.recordings.recording import DEMO as RECORDING
from finforce_eval.replay.processes import ProcessError
from finforce_ifea.settings import SOLVERS
from lab.bench import process as bench_process
from lab.bench import solvers as bench_solvers
from lab.bench import tiers as bench_tiers
from lab.bench.bench import row_from_times
from lab.bench.cases import bench_finger, load_cases, record_press
from lab.bench.process import Start, measure_start
from lab.bench.recordings import find_recordings, measure_recordings
from lab.bench.solvers import SolverFigures, TierFigures, as_json, compare_with_sofa, find_fronts
from lab.bench.tiers import TIERS, Run, Tier, list_tiers, rms, run_tier, score_runs, score_shapes

JAW = bench_finger()
CASES = {case.name: case for case in load_cases()}
PRESSES = [record_press(CASES[f"Ø25 {height}"], JAW) for height in ("lower", "middle", "upper")]


def perfect(press, factor=1.0):
    return Run(press=press, force=factor * press.force, seconds=np.full(9, 1e-3), cpu=np.full(9, 1e-3))


def figures_of(name, time, error, lost=0.0):
    accuracy = replace(score_runs([perfect(PRESSES[0])]), rmse=error, lost=lost)
    row = row_from_times(name, np.full(5, 1e-3 * time))
    return TierFigures(
        tier=Tier(name=name, solver="solid"), exact=accuracy, noisy=accuracy,
        shapes=replace(score_shapes([perfect(PRESSES[0])]), rmse=error), step_exact=row, step=row, cpu=row,
        yardstick=row_from_times(name, np.full(5, 6e-3)),
        start=Start(memory=200.0, imports=0.3, build=0.4, build_uncached=None, cache=0.0),
    )  # fmt: skip


def test_every_registered_solver_is_a_tier_and_the_slow_one_can_be_left_out():
    # the bench finger is a drawing, which solver plane does not describe
    assert {tier.solver for tier in list_tiers()} == set(SOLVERS) - {"default", "plane"}
    assert {tier.name for tier in list_tiers()} - {tier.name for tier in list_tiers(slow=False)} == {"solid, fine mesh"}


def test_solver_registered_later_becomes_a_tier(monkeypatch):
    monkeypatch.setattr(bench_tiers, "SOLVERS", (*SOLVERS, "new"))
    assert list_tiers()[-1] == Tier(name="new", solver="new")


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

    monkeypatch.setattr(bench_tiers, "JawEstimator", Estimator)
    run = run_tier(TIERS[0], JAW, PRESSES[:1])[0]
    frames = len(PRESSES[0].observations)
    assert len(run.seconds) == len(run.cpu) == frames // 4
    assert np.isnan(run.force[:, 0]).sum() == pytest.approx(frames / 2, abs=1)


def test_frame_finds_the_forces_of_the_independent_program():
    runs = run_tier(Tier(name="frame", solver="frame"), JAW, PRESSES[1:])
    accuracy, shapes = score_runs(runs), score_shapes(runs)
    # within 3 % of the largest force, 4 N, which is what the frame's verification allows at these heights
    assert accuracy.rmse < 0.12
    assert accuracy.lost == 0.0
    assert shapes.solved == shapes.n == 10


def test_shape_errors_tell_a_wrong_modulus_from_a_wrong_shape():
    runs = [perfect(press, factor) for press, factor in zip(PRESSES, (2.0, 4.0, 8.0), strict=True)]
    errors = score_shapes(runs)
    assert errors.rmse > errors.one_factor > 0.1
    assert errors.factor_per_height == pytest.approx(0.0, abs=1e-9)
    assert errors.by_height.keys() == {"lower", "middle", "upper"}
    same = score_shapes([perfect(press, 4.0) for press in PRESSES])
    assert same.factor == pytest.approx(0.25)
    assert same.one_factor == pytest.approx(0.0, abs=1e-9)


def test_unanswered_frames_are_counted_and_in_no_error():
    run = perfect(PRESSES[0])
    force = run.force.copy()
    force[np.flatnonzero(PRESSES[0].held)[:15]] = np.nan
    accuracy = score_runs([replace(run, force=force)])
    assert accuracy.lost == pytest.approx(0.1)
    assert accuracy.rmse == 0.0
    assert score_runs([replace(run, force=force + [1.0, 0.0, 0.0])]).rmse > 0.5
    assert np.isnan(rms(np.full(3, np.nan)))


def test_front_is_of_tiers_that_answer():
    tiers = [figures_of("fast", 1, 0.5), figures_of("slow", 3, 0.1), figures_of("bad", 2, 0.6)]
    fronts = find_fronts(SolverFigures(tiers=tiers))
    assert [point.text for point in fronts["noisy"]] == ["fast", "slow"]
    quiet = [*tiers, figures_of("silent", 0.5, 0.01, lost=0.5)]
    assert [point.text for point in find_fronts(SolverFigures(tiers=quiet))["exact"]] == ["fast", "slow"]


def test_peer_is_compared_on_this_machine_and_on_its_own():
    compared = compare_with_sofa(figures_of("fast", 1.3, 0.074))
    assert compared["rate"] == pytest.approx(3.0)
    assert compared["rate_by_yardstick"] == pytest.approx(6.0)  # a yardstick of 6 ms for the peer's 3 ms
    assert compared["error_share"] == pytest.approx(0.1)


def test_table_json_and_picture_hold_every_tier(tmp_path):
    figures = SolverFigures(tiers=[figures_of("fast", 1, 0.5), figures_of("slow", 3, 0.1, lost=0.2)], notes=["a note"])
    table = bench_solvers.format_table(figures)
    assert "fast" in table and "a note" in table and "20.0%" in table
    content = json.loads(json.dumps(as_json(figures)))
    assert [tier["tier"]["name"] for tier in content["tiers"]] == ["fast", "slow"]
    assert content["fronts"]["noisy"] == ["fast"]
    assert content["quoted"]["sofa"]["step_ms"] == 3.9
    bench_solvers.draw(figures, tmp_path / "pareto.png")
    assert drawn_hues(tmp_path / "pareto.png") >= 2  # noise-free and noisy


def test_tier_that_does_not_exist_is_noted_and_the_others_are_measured(monkeypatch):
    tiers = (Tier(name="nothing", solver="nothing"), Tier(name="frame", solver="frame", contact="outline"))
    monkeypatch.setattr(bench_solvers, "list_tiers", lambda slow, section: tiers)
    monkeypatch.setattr(bench_solvers, "load_cases", lambda: (CASES["Ø25 middle"],))
    figures = bench_solvers.measure(True)
    assert [tier.tier.name for tier in figures.tiers] == ["frame"]
    assert figures.notes[0].startswith("nothing: not measured: solver: got 'nothing'")
    assert figures.tiers[0].noisy.rmse < 0.3


def test_fresh_process_tells_memory_and_set_up():
    start = measure_start("frame", "default")
    assert 30 < start.memory < 2000
    assert start.build > 0 and start.imports > 0


def test_set_up_is_measured_again_where_the_first_process_left_a_cache(monkeypatch):
    probes = []

    def probe(solver, mesh, jaw, folder):
        probes.append(folder)
        if solver == "caching":
            with open(f"{folder}/tables", "wb") as file:
                file.write(bytes(2_000_000))
        return {"memory": 100.0, "imports": 0.1, "build": 10.0 / len(probes)}

    monkeypatch.setattr(bench_process, "_probe", probe)
    start = measure_start("caching", "default")
    assert (start.build_uncached, start.build, start.cache) == (10.0, 5.0, pytest.approx(2.0))
    assert probes[0] == probes[1]
    probes.clear()
    assert measure_start("plain", "default").build_uncached is None
    assert len(probes) == 1


def test_process_that_fails_is_an_error():
    with pytest.raises(ProcessError, match="solver nothing ended with 1"):
        measure_start("nothing", "default")


def test_recordings_in_a_folder_are_scored_with_each_tier(tmp_path):
    shutil.copytree(RECORDING, tmp_path / RECORDING.name)
    done = []
    tiers = [Tier(name="nothing", solver="nothing"), Tier(name="frame", solver="frame")]
    rows = measure_recordings(tmp_path, tiers, done.append)
    assert [row.tier for row in rows] == ["frame"]
    assert done == [f"frame, {RECORDING.name}"]
    # what `finforce evaluate` says of the shipped recording, 0.05 N, and as much again
    assert 0.0 < rows[0].rmse < 0.1
    assert rows[0].unsolved == ()


def test_folder_without_recordings_is_refused(tmp_path):
    with pytest.raises(OptionError, match="no recordings"):
        find_recordings(tmp_path)
