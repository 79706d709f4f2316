"""Claims about what further parts of the benchmark count: mechanics, meshes, faults."""

import numpy as np
import pandas as pd
import pytest

from lab.bench import driver_faults, grasp_faults, images, mechanics, reconstruction
from lab.bench.cases import load_cases
from lab.harness import format_figures


def test_the_frame_is_as_stiff_as_the_independent_program():
    case = next(case for case in load_cases() if case.name == "Ø25 middle")
    model = next(model for model in mechanics.MODELS if model.solver == "frame")
    (row,) = mechanics.press_model(model, [case])
    assert abs(row["force, worst/%"]) < 1.0 and row["key points, worst/mm"] < 0.15
    assert row["turn/mrad"] == pytest.approx(row["true turn/mrad"], rel=0.03)


def test_the_summary_holds_the_largest_error_at_each_height():
    rows = pd.DataFrame(
        {
            "model": ["a", "a", "b"],
            "case": ["Ø15 lower", "Ø25 upper", "Ø15 lower"],
            "force, worst/%": [-3.0, 2.0, 1.0],
            "key points, worst/mm": [0.1, 0.4, 0.2],
        }
    )
    a, b = mechanics.summarise(rows).to_dict("records")
    assert (a["force, all/%"], a["force, upper/%"], a["key points, all/mm"]) == (3.0, 2.0, 0.4)
    assert b["force, lower/%"] == 1.0 and np.isnan(b["force, upper/%"])


def test_a_shipped_finger_is_described():
    row = mechanics.describe_finger("bench")
    assert row["size/mm"] == "28.0 x 20.0 x 80.0"
    assert row["at half/N/mm"] == pytest.approx(0.29, abs=0.01)  # docs/fingers.md


def test_a_method_that_gave_up_is_in_no_distance():
    trials = [
        {"condition": "c", "method": "m", "object": "cube", "seed": n, "mean/mm": mean, "CPU/s": 1.0}
        for n, mean in enumerate((1.0, 3.0, np.nan))
    ]
    row = reconstruction.summarise(pd.DataFrame(trials)).iloc[0]
    assert (row["n"], row["gave up"], row["all/mm"], row["largest/mm"], row["cube/mm"]) == (3, 1, 2.0, 3.0, 2.0)


def test_faults_between_driver_and_gripper_do_no_harm(monkeypatch):
    monkeypatch.setattr(driver_faults, "run_all", lambda faults: driver_faults.FaultRun(1, 20, list(KINDS)).run())
    text = format_figures(driver_faults.measure(True))
    assert "wrong states" in text and "Largest differences" in text


KINDS = driver_faults.LINE_FAULTS


def test_grasps_with_faults_stay_below_the_limit():
    tally = grasp_faults.play_all(6)
    assert tally.cases == len(tally.excess) == 6
    assert not tally.complaints and not tally.wrong
    assert sum(tally.ends.values()) == 6


def test_a_scene_without_a_force_is_noted_and_the_others_are_measured(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(images, "find_scene", lambda scene, folder: folder / f"{scene.scenario}_{scene.seed}")
    monkeypatch.setattr(images, "UNSEEN", {name: (name, {}) for name in ("cylinder", "cube")})
    sight = dict.fromkeys(("pixel_median_px", "pixel_p95_px", "point_median_mm", "point_p95_mm"), 1.0)
    found = {
        "sight": {**sight, "hidden_accepted_pct": None, "visible_lost_pct": 2.0},
        "record_skipped": 1,
        "record_frames": 10,
        "detector_ms": {"p50": 9.0, "p95": 12.0},
        "delay": None,
    }

    def evaluate(bag, source, words):
        asked.append((bag.name, source))
        if bag.name == "cube_101":
            raise images.FinforceError("no force")
        return {"all": {**found, "all": {"rmse_N": 0.3 if source == "images" else 0.1}}}

    monkeypatch.setattr(images, "evaluate", lambda bag, source, words: evaluate(bag, source, words)["all"])
    figures = images.measure(False, folder=tmp_path)
    (row,) = figures.tables["images"].to_dict("records")
    assert (row["scene"], row["added/N"], row["solved/%"]) == ("cylinder", pytest.approx(0.2), 90.0)
    assert figures.notes[1] == "cube bench 101: no force"
