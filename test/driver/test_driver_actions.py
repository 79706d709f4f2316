"""Claims about the driver's actions over real ROS, in a process that has control_msgs."""

from pathlib import Path

import message_fakes


def test_both_actions_move_the_gripper_over_real_ros():
    said = message_fakes.run_trials("control_msgs", Path(__file__).with_name("action_trials.py"))
    assert "9 passed" in said
