"""Claims about the benchmark of skipped work: what is played when, and what its figures say."""

import pandas as pd
import pytest

from finforce_eval.errors import RecordingError
from finforce_eval.replay.playback import RawMessage
from finforce_keypoints.parameters import COLOR_TOPIC
from lab.bench.scenes import SceneStream, StreamPart, cut_sections, read_word
from lab.bench.skipping import arrange

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


def test_the_table_sets_a_node_with_the_rules_beside_the_same_without():
    common = {"node": "solver", "grasp forces/Hz": 30.0, "other load/%": 12.0, "memory/MB": 250.0}
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
