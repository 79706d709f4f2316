"""The subcommand `extrinsics`: images of jaws at rest in, the camera's place in the gripper out."""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from finforce.transforms import pose_numbers, rotation_between
from finforce_eval.errors import OptionError
from finforce_eval.evaluation.at_rest import ROUNDS, approach, first_images
from finforce_eval.evaluation.keypoint_source import build_records, choose_images, parse_source
from finforce_eval.evaluation.setup import read_recordings
from finforce_eval.recordings.tracks import JAWS
from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints.geometry.extrinsics import Extrinsics


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument("bags", nargs=1, metavar="BAG", help="rosbag2 folder, .mcap or .db3 file with images")
    parser.add_argument("--jaw", default="bench", metavar="FILE", help="jaw file, or a shipped name (bench)")
    parser.add_argument("--jaws", default="both", choices=("left", "right", "both"), help="in the images (both)")
    text = "where the camera is about: robot, bench, or x,y,z,qx,qy,qz,qw; without it that of the case.json, else robot"
    parser.add_argument("--extrinsics", metavar="POSE", help=text)
    text = "change a parameter of the key point detector, as model=FOLDER; repeatable"
    parser.add_argument("--detector", action="append", default=[], metavar="NAME=VALUE", help=text)
    text = "how many images at the beginning show the jaws at rest (45)"
    parser.add_argument("--images", type=int, default=45, metavar="N", help=text)


def run(options: argparse.Namespace) -> None:
    """Find the camera's place from the first images of a recording, and print it as the nodes take it."""
    options.source = "images"
    if options.images < 5:
        raise OptionError(f"--images {options.images}: expected at least 5, the mean of which is taken")
    source = parse_source(options)
    sides = JAWS if options.jaws == "both" else (options.jaws,)
    (recording,) = read_recordings(options.bags, source.pairing, sides=sides)
    recording = first_images(recording, options.images)
    recording = replace(recording, jaws={side: recording.jaws[side] for side in sides})
    start = build_records(source.node_parameters(recording)).parameters
    recording = replace(recording, images=choose_images(recording, start.depth))
    jaws = {side: load_jaw(options.jaw, side) for side in sides}
    with tqdm(total=ROUNDS * len(recording.images), unit="image", disable=None, leave=False) as bar:
        found, _ = approach(recording, source, jaws, start.camera_pose, bar.update)
    print(format_extrinsics(found, start.camera_pose))


def format_extrinsics(found: Extrinsics, guess: NDArray) -> str:
    """Return the place as a parameter of the nodes, how good it is, and how far from the guess (4, 4)."""
    T = found.T_gripper_camera
    numbers = ", ".join(f"{number:.6f}" for number in pose_numbers(T))
    millimetres = ", ".join(f"{1e3 * spread:.2f}" for spread in found.stddev[:3])
    degrees = ", ".join(f"{np.degrees(spread):.2f}" for spread in found.stddev[3:])
    origins = ", ".join(f"{side} {1e3 * x:.1f} mm" for side, x in found.origins.items())
    moved, turned = 1e3 * np.linalg.norm(T[:3, 3] - guess[:3, 3]), np.degrees(rotation_between(guess, T))
    return (
        f"T_gripper_camera: [{numbers}]  # m, quaternion x y z w\n"
        f"standard deviation {millimetres} mm; {degrees} degrees; left over {found.residual:.2f} px\n"
        f"jaw origins: {origins}; {moved:.2f} mm and {turned:.2f} degrees from the guess"
    )
