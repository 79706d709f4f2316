"""Record with an SO-101, train a policy on forces, run it: `policy_with_forces.py record annotate train run`."""

import subprocess
import sys
import time

import torch
from lerobot.cameras.opencv import OpenCVCameraConfig
from lerobot.datasets.lerobot_dataset import LeRobotDatasetMetadata
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.utils import build_inference_frame, make_robot_action
from lerobot.robots.so_follower import SO101Follower, SO101FollowerConfig

from finforce_eval.lerobot import ForceProcessorStep

RIG, CALIBRATION, PORT = "wrist_rig.yaml", "my_finger_calibration.yaml", "/dev/ttyACM0"  # made by finforce; the arm's
CAMERA = "{wrist: {type: opencv, index_or_path: 0, width: 640, height: 480, fps: 30}}"
COMMANDS = {
    "record": f"lerobot-record --robot.type=so101_follower --robot.port={PORT} --robot.cameras='{CAMERA}' "
    "--teleop.type=so101_leader --teleop.port=/dev/ttyACM1 --dataset.repo_id=me/grasps --dataset.root=grasps "
    "--dataset.single_task='hold the cup' --dataset.push_to_hub=false",
    "annotate": f"finforce annotate grasps --into state --rig {RIG} --calibration {CALIBRATION} --contact fixed:40",
    "train": "lerobot-train --policy.type=act --policy.push_to_hub=false --dataset.repo_id=me/grasps "
    "--dataset.root=annotated/grasps --output_dir=trained",
}


def run(robot, checkpoint, root, step, seconds=20.0, device="cpu"):
    """Let a policy act for a while; the jaws are open and touch nothing for the first 1.5 s."""
    features, device = LeRobotDatasetMetadata("me/grasps", root=root).features, torch.device(device)
    policy = ACTPolicy.from_pretrained(checkpoint).to(device).eval()
    preprocess, postprocess = make_pre_post_processors(policy.config, checkpoint)
    policy.reset()
    step.reset()
    for number in range(round(step.fps * seconds)):
        begin = time.perf_counter()
        seen = step.observation(robot.get_observation())
        if number > 1.5 * step.fps:
            with torch.inference_mode():
                frame = preprocess(build_inference_frame(seen, device, features))
                robot.send_action(make_robot_action(postprocess(policy.select_action(frame)), features))
        time.sleep(max(0.0, 1.0 / step.fps - (time.perf_counter() - begin)))


if __name__ == "__main__":
    for name in sys.argv[1:]:  # record annotate train run
        if name in COMMANDS:
            subprocess.run(COMMANDS[name], shell=True, check=True)
            continue
        wrist = OpenCVCameraConfig(index_or_path=0, width=640, height=480, fps=30)
        forces = ForceProcessorStep(camera="wrist", rig=RIG, calibration=CALIBRATION, contact_height=0.040)
        with SO101Follower(SO101FollowerConfig(port=PORT, cameras={"wrist": wrist})) as arm:
            run(arm, "trained/checkpoints/last/pretrained_model", "annotated/grasps", forces)
