"""Claims about the driver's actions over real ROS, in a process that has control_msgs."""

import subprocess
import sys
from pathlib import Path

import message_fakes


def test_both_actions_move_the_gripper_over_real_ros():
    trials = Path(__file__).with_name("action_trials.py")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", "0", str(trials)]
    environment = message_fakes.environment("control_msgs")
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-3000:]
    assert "9 passed" in done.stdout
