"""Claims about what further parts of the benchmark count: images."""

import pytest

from lab.bench import images


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
