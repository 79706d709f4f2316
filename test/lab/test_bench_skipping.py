"""Claims about the benchmark of skipped work: which images belong to a scene, and what is counted of it."""

import pandas as pd
import pytest

from finforce.stamps import NANOSECONDS
from finforce_eval.recordings.tracks import parse_phases
from finforce_eval.replay.playback import RawMessage
from lab.bench import skipping
from lab.bench.skipping import SCENE, SETTLED, WARM_UP, SceneMeter, arrange, find_spans


def test_idling_approach_and_holding_are_measured_once_they_have_begun():
    from finforce_sim.scenarios import write_script

    script = write_script(SCENE.build())
    begins = [n for n, word in enumerate(script.phases) if n == 0 or word != script.phases[n - 1]]
    stamps = [round(NANOSECONDS * script.stamps[n]) for n in begins]
    spans = find_spans(parse_phases(stamps, [script.phases[n] for n in begins], "scene"))
    seconds = {name: (end - begin) / NANOSECONDS for name, (begin, end) in spans.items()}
    assert seconds["idle"] == pytest.approx(SCENE.changes["tare"] - WARM_UP, abs=0.04)
    assert seconds["approach"] == pytest.approx(3.0, abs=0.04)  # 15 mm at 5 mm/s
    assert seconds["grasp"] == pytest.approx(SCENE.changes["record"] + SCENE.changes["settle"] - SETTLED, abs=0.04)
    assert spans["approach"][1] < spans["grasp"][0]


def test_cpu_time_is_read_where_a_scene_begins_and_ends(monkeypatch):
    made = []

    monkeypatch.setattr(skipping, "begin_shares", lambda pids: made.append("begin") or pids)
    monkeypatch.setattr(skipping, "end_shares", lambda processes: made.append("end") or {"node": 10.0 * len(made)})
    meter = SceneMeter(spans={"idle": (10, 20), "grasp": (30, 40)})
    for time in (0, 12, 15, 22, 31, 39, 45):
        meter.note({"node": 1}, RawMessage(time, "/camera", "Image", b"", False))
    assert list(meter.shares) == ["idle", "grasp"]
    # what is before, between and after the scenes begins, and is not asked for
    assert made == ["begin", "end", "begin", "begin", "end", "begin"]


def test_the_table_sets_a_node_with_the_rules_beside_the_same_without():
    common = {"node": "solver", "grasp forces/Hz": 30.0, "memory/MB": 250.0}
    rows = [
        {**common, "rules": rules, "scene": scene, "CPU/% of a core": cpu}
        for rules, scene, cpu in (
            ("on", "idle", 1.5),
            ("on", "grasp", 4.0),
            ("off", "idle", 6.0),
            ("off", "grasp", 10.0),
        )
    ]
    table = arrange(pd.DataFrame(rows))
    assert table["scene"].tolist() == ["idle", "grasp"]
    assert table["on: CPU/% of a core"].tolist() == [1.5, 4.0]
    assert table["off: CPU/% of a core"].tolist() == [6.0, 10.0]
