"""The subcommand `extrinsics`: images of jaws at rest in, the camera's pose in the gripper out."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finforce.transforms import pose_numbers, rotation_between
from finforce_eval.cli.parser import BAG_HELP, CommandResult, add_rest_options, length_mm
from finforce_eval.errors import OptionError
from finforce_eval.evaluation.at_rest import ROUNDS, approach, first_images
from finforce_eval.evaluation.keypoint_source import KeypointSource, build_records, choose_images, parse_source
from finforce_eval.evaluation.setup import read_recordings
from finforce_eval.recordings.frames import read_picture
from finforce_eval.recordings.tracks import Recording
from finforce_eval.tasks import progress_bar
from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints.geometry.extrinsics import Extrinsics, GridCamera, find_grid_camera


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    text = f"{BAG_HELP}, with images; with --grid, an image"
    parser.add_argument("bags", nargs=1, metavar="BAG", help=text)
    text = "find intrinsics and pose of the camera from an image of a table with holes of this pitch [mm]"
    parser.add_argument("--grid", type=length_mm, metavar="MM", help=text)
    add_rest_options(parser, images=45)


def run(options: argparse.Namespace) -> CommandResult:
    """Find the camera's pose from the first images of a recording, and print it as the nodes take it."""
    if options.grid is not None:
        above = find_grid_camera(read_picture(Path(options.bags[0])), options.grid)
        print(format_grid_camera(above))
        pose = pose_numbers(above.T_camera_table)
        return CommandResult({"camera": vars(above.camera), "T_camera_table": pose, "residual_px": above.residual})
    source, recording = read_at_rest(options)
    start = build_records(source.node_parameters(recording)).parameters
    recording = replace(recording, images=choose_images(recording, start.depth))
    jaws = {side: load_jaw(options.jaw, side) for side in recording.jaws}
    with progress_bar(ROUNDS * len(recording.images), "image") as bar:
        found, _ = approach(recording, source, jaws, start.camera_pose, bar.update)
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


def format_grid_camera(found: GridCamera) -> str:
    """Return a camera above a table, as a file of intrinsics has it, and its pose."""
    camera, pose = found.camera, ", ".join(f"{number:.6f}" for number in pose_numbers(found.T_camera_table))
    lens = ", ".join(f"{number:.5f}" for number in camera.distortion)
    return (
        f"width: {camera.width}\nheight: {camera.height}\nfx: {camera.fx:.2f}\nfy: {camera.fy:.2f}\n"
        f"cx: {camera.cx:.2f}\ncy: {camera.cy:.2f}\ndistortion: [{lens}]\n"
        f"T_camera_table: [{pose}]  # m, quaternion x y z w; z away from the camera\n"
        f"# {len(found.holes)} holes, left over {found.residual:.2f} px"
    )


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
