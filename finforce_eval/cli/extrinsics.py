"""The subcommand `extrinsics`: images of jaws at rest in, the camera's pose in the gripper out."""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from finforce.transforms import pose_numbers, rotation_between
from finforce_eval.cli.parser import BAG_HELP, CommandResult, add_rest_options
from finforce_eval.errors import OptionError
from finforce_eval.evaluation.at_rest import ROUNDS, approach, doubt_lens, first_images
from finforce_eval.evaluation.keypoint_source import KeypointSource, build_records, choose_images, parse_source
from finforce_eval.evaluation.setup import print_notes, read_recordings
from finforce_eval.recordings.tracks import Recording
from finforce_eval.tasks import progress_bar
from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints.geometry.extrinsics import Extrinsics


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument("bags", nargs=1, metavar="BAG", help=f"{BAG_HELP}, with images")
    add_rest_options(parser, images=45)


def run(options: argparse.Namespace) -> CommandResult:
    """Find the camera's pose from the first images of a recording, and print it as the nodes take it."""
    source, recording = read_at_rest(options)
    start = build_records(source.node_parameters(recording)).parameters
    recording = replace(recording, images=choose_images(recording, start.depth))
    jaws = {side: load_jaw(options.jaw, side) for side in recording.jaws}
    with progress_bar(ROUNDS * len(recording.images), "image") as bar:
        found, _ = approach(recording, source, jaws, start.camera_pose, bar.update)
    print_notes(recording.name, doubt_lens(found, recording, source, start.camera_pose))
    print(format_extrinsics(found, start.camera_pose))
    pose, stddev = pose_numbers(found.T_gripper_camera), found.stddev.tolist()
    return CommandResult(
        {"T_gripper_camera": pose, "stddev": stddev, "residual_px": found.residual, "origins": found.origins}
    )


def read_at_rest(options: argparse.Namespace) -> tuple[KeypointSource, Recording]:
    """Return the detector's parameters, and the first images of a recording, in which the asked jaws are at rest.

    Raises:
        FinforceError: an option or the recording cannot be used, or has too few images.
    """
    options.source = "images"
    if options.images < 5:
        raise OptionError(f"--images {options.images}: expected at least 5, which are averaged")
    source = parse_source(options)
    (recording,) = read_recordings(options.bags, source)
    recording = first_images(recording, options.images)
    return source, replace(recording, jaws={side: recording.jaws[side] for side in source.sides})


def format_extrinsics(found: Extrinsics, guess: NDArray) -> str:
    """Return the pose as a parameter of the nodes, how good it is, and how far from the guess (4, 4)."""
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
