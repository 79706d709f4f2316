"""Claims about the benchmark of skipped work: what is played when, and what its figures say."""

from dataclasses import replace

import pytest
from eval_fakes import drawn_hues

from finforce.skipping import EVERYWHERE
from finforce_eval.errors import RecordingError
from finforce_eval.replay.playback import RawMessage
from finforce_keypoints.parameters import COLOR_TOPIC
from lab.bench.scenes import SceneStream, StreamPart, cut_sections, read_word
from lab.bench.skipping import (
    EACH,
    OF_NODE,
    OFF,
    ON,
    SceneCost,
    SkippingFigures,
    as_json,
    draw,
    draw_costs,
    find_cost,
    format_each,
    format_table,
)

SECOND = 1_000_000_000


def message(time, topic=COLOR_TOPIC, text="", has_header=True):
    """A message with its stamp; or a std_msgs/String."""
    if text:
        word = text.encode() + b"\0"
        return RawMessage(
            time, topic, "std_msgs/msg/String", b"\0\1\0\0" + len(word).to_bytes(4, "little") + word, False
        )
    stamp = (time // SECOND).to_bytes(4, "little") + (time % SECOND).to_bytes(4, "little")
    return RawMessage(time, topic, "sensor_msgs/msg/Image", b"\0\1\0\0" + stamp + b"rest", has_header)


def recording():
    """Four images: two of one phase, one of a phase that nobody asked for, one of another."""
    for number, phase in enumerate(("a:1", "a:2", "b:1", "c:1")):
        time = (number + 1) * SECOND
        yield message(time, "/bench/phase", phase)
        yield message(time)
        yield message(time, "/left/ground_truth_wrench")


def test_sections_hold_the_images_of_their_phases_and_nothing_but_what_is_played():
    sections = cut_sections(recording(), {"a:": "first", "c:": "last"})
    assert {name: len(images) for name, images in sections.items()} == {"first": 2, "last": 1}
    assert {part.topic for images in sections.values() for image in images for part in image} == {COLOR_TOPIC}
    assert read_word(message(0, "/bench/phase", "0:load:7:ramp").data) == "0:load:7:ramp"


def test_a_reel_repeats_a_section_with_rising_stamps_at_its_rate():
    sections = cut_sections(recording(), {"a:": "first", "c:": "last"})
    parts = [StreamPart(section="first", seconds=0.5, name="shown"), StreamPart(section="last", seconds=0.1)]
    stream = SceneStream(sections, parts, rate=10.0)
    played = list(stream)
    assert len(played) == len(stream) == 6
    assert [entry.time - stream.begin for entry in played] == [round(0.1 * k * SECOND) for k in range(6)]
    assert [entry.stamp for entry in played] == [entry.time for entry in played]
    assert [(span.begin, span.end) for span in stream.spans] == [(0.0, 0.5), (0.5, pytest.approx(0.6))]


def test_a_section_without_images_is_refused():
    with pytest.raises(RecordingError, match="no images of the section 'press'"):
        SceneStream({}, [StreamPart(section="press", seconds=1.0)])


def figures():
    costs = [
        SceneCost(setting=setting, scene=scene, node="solver", cpu=cpu, others=12.0, images=30.0)
        for setting, scene, cpu in ((ON, "idle", 1.5), (OFF, "idle", 6.0), (ON, "grasp", 4.0), (OFF, "grasp", 10.0))
    ]
    return SkippingFigures(costs=costs, memory={ON: {"solver": 250.0}}, skipped={"solver": {"no object near": "7"}})


def test_the_table_sets_a_node_with_the_rules_beside_the_same_without():
    found = figures()
    assert find_cost(found, OFF, "grasp", "solver") == 10.0
    line = next(line for line in format_table(found).splitlines() if line.startswith("solver"))
    assert line.split()[1:] == ["1.5", "6.0", "0.25", "nan", "nan", "nan", "4.0", "10.0", "0.40", "250"]
    assert "Everything else on the machine: rules on, idle: 12 %" in format_table(found)


def test_the_json_holds_figures_and_aims():
    written = as_json(figures())
    assert written["costs"][0]["cpu"] == 1.5 and written["skipped"]["solver"] == {"no object near": "7"}
    assert written["aims"] == {"idle_pct": 2.0, "steady_share": 0.5}


def test_the_picture_has_a_panel_for_each_scene(tmp_path):
    draw(figures(), tmp_path / "picture.png")
    assert drawn_hues(tmp_path / "picture.png") >= 1
    picture = draw_costs(figures())
    assert [axes.get_title(loc="left") for axes in picture.axes] == ["idle", "approach", "grasp"]


def test_a_rule_that_is_off_alone_is_set_beside_all_of_them():
    found = figures()
    alone = [cost for cost in found.costs if cost.setting == OFF]
    both = replace(found, memory={ON: {}, OFF: {}}, costs=[*found.costs, *(replace(cost, node="x") for cost in alone)])
    line = next(line for line in format_each(both).splitlines() if line.startswith(OFF))
    assert line.split()[-6:-4] == ["12.0", "nan"]  # 6 % each; the second node was not measured with all rules
    only = replace(found, memory={ON: {}, OFF: {}})
    line = next(line for line in format_each(only).splitlines() if line.startswith(OFF))
    assert line.split()[-6:] == ["6.0", "4.5", "nan", "nan", "10.0", "6.0"]


def test_every_rule_that_is_measured_alone_is_one_of_some_node():
    known = {rule for rules in (EVERYWHERE, *OF_NODE.values()) for rule in rules}
    assert {rule for off in EACH.values() for rule in off} - {""} <= known
