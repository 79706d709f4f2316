"""Claims about `finforce pipeline`: which nodes are in the process, and which words it refuses."""

import json

import pytest

from finforce_eval.cli.main import main
from finforce_eval.cli.pipeline import pipeline_process
from finforce_eval.errors import OptionError


def parts_of(*words):
    return [json.loads(part) for part in pipeline_process(list(words)).arguments]


def test_all_stages_of_both_jaws_are_in_one_process_in_the_order_of_an_image():
    parts = parts_of("object_mesh:=can.stl", "jaw_file:=umi")
    assert [part[0] for part in parts] == ["keypoint_detector", "contact_estimator", "ifea_solver", "ifea_solver"]
    assert "__node:=left_ifea_solver" in parts[2] and "__node:=right_ifea_solver" in parts[3]
    assert 'object_mesh:="can.stl"' in parts[1] and all('jaw_file:="umi"' in part for part in parts)
    assert all("use_sim_time:=false" in part for part in parts)


def test_one_jaw_at_a_known_height_needs_no_contact_estimator_and_the_driver_comes_last():
    parts = parts_of("jaws:=left", "contact_height:=0.04", "gripper:=true", "gripper_port:=/dev/ttyACM0")
    assert [part[0] for part in parts] == ["keypoint_detector", "ifea_solver", "gripper_driver"]
    assert "contact_height:=0.04" in parts[1] and 'port:="/dev/ttyACM0"' in parts[2]


def test_depth_none_is_colour_alone():
    assert 'depth:="none"' in parts_of("depth:=none", "contact_height:=0.04")[0]


@pytest.mark.parametrize(
    ("word", "reason"),
    [
        ("sim:=true", "'sim' is not an option"),
        ("nothing", "'nothing' is not an option"),
        ("jaws:=three", "jaws: got 'three', expected one of left, right, both"),
        ("images:=perhaps", "expected true or false"),
        ("contact_height:=low", "expected a float"),
    ],
)
def test_a_word_that_is_no_option_is_refused(word, reason, capsys):
    with pytest.raises(OptionError, match=reason):
        pipeline_process([word])
    assert main(["pipeline", word]) == 2
    assert reason in capsys.readouterr().err
