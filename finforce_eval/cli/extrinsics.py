"""The subcommand `extrinsics`: images of jaws at rest in, the camera's place in the gripper out."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from finforce.transforms import pose_numbers, rotation_between
from finforce_eval.errors import OptionError, RecordingError
from finforce_eval.evaluation.keypoint_source import Detector, KeypointSource, build_records, parse_source
from finforce_eval.evaluation.setup import read_recordings
from finforce_eval.recordings.tracks import JAWS, Recording
from finforce_ifea.jaw.jaw import Jaw, load_jaw
from finforce_keypoints.geometry.extrinsics import Extrinsics, SeenJaw, find_extrinsics

ROUNDS = 4  # of finding the key points with the place found before
_LOOSE = {"detector.reference_tolerance": 0.02, "detector.lost_images": 1000}  # [m]; a guess is allowed to be far off
_STILL = 0.05e-3  # [m] below which another round changes nothing
_OFTEN = 0.5  # share of the images in which a key point has to be seen


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
    recording = _first_images(recording, options.images)
    recording = replace(recording, jaws={side: recording.jaws[side] for side in sides})
    start = build_records(source.node_parameters(recording)).parameters
    found = _approach(recording, source, {side: load_jaw(options.jaw, side) for side in sides}, start.camera_pose)
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


def _first_images(recording: Recording, count: int) -> Recording:
    """Return a recording with its first images alone."""
    images = recording.images
    if images is None:
        raise RecordingError(f"{recording.name}: no images; record colour, aligned depth and camera_info")
    if len(images) < count:
        raise RecordingError(f"{recording.name}: {len(images)} images, expected at least {count} of jaws at rest")
    return replace(recording, images=images.between(int(images.stamps[0]), int(images.stamps[count - 1]) + 1))


def _approach(recording: Recording, source: KeypointSource, jaws: Mapping[str, Jaw], guess: NDArray) -> Extrinsics:
    """Find the key points, with these the place, and again with that place, until nothing moves."""
    T = guess
    with tqdm(total=ROUNDS * len(recording.images), unit="image", disable=None, leave=False) as bar:
        for _ in range(ROUNDS):
            here = replace(
                source, parameters={**_LOOSE, **source.parameters, "T_gripper_camera": list(pose_numbers(T))}
            )
            seen = _look(recording, here.build(recording), jaws, bar.update)
            origins = [abs(float((T @ pose)[0, 3])) for poses in seen.poses.values() for pose in poses]
            found = find_extrinsics(seen.jaws, recording.images.camera, T, float(np.median(origins)))
            moved = float(np.linalg.norm(found.T_gripper_camera[:3, 3] - T[:3, 3]))
            T = found.T_gripper_camera
            if moved < _STILL:
                break
    return found


@dataclass(frozen=True, kw_only=True, eq=False)
class _Look:
    """What a detector saw: the jaws, and where it took them to be, T_camera_jaw (4, 4) of every image by side."""

    jaws: Mapping[str, SeenJaw]
    poses: Mapping[str, Sequence[NDArray]]


def _look(recording: Recording, detector: Detector, jaws: Mapping[str, Jaw], progress: Callable[[int], Any]) -> _Look:
    """Average the pixels of the key points over the images."""
    pixels: dict[str, list[NDArray]] = {side: [] for side in jaws}
    poses: dict[str, list[NDArray]] = {side: [] for side in jaws}
    for _, image in recording.images:
        for side, found in detector.detect(image).items():
            blind = np.isin(found.reasons, ("image", "likelihood"))[:, None]
            pixels[side].append(np.where(blind, np.nan, found.pixels))
            poses[side].append(found.T_camera_jaw)
        progress(1)
    for side, seen in pixels.items():
        if len(seen) < _OFTEN * len(recording.images):
            raise RecordingError(
                f"{recording.name}: the {side} jaw was found in {len(seen)} of {len(recording.images)} images: are the "
                "jaws in view and is the guess, --extrinsics, within some 10 mm and 5 degrees?"
            )
    averaged = {side: _average(np.array(seen)) for side, seen in pixels.items()}
    return _Look(jaws={side: SeenJaw(points=jaws[side].keypoints, pixels=averaged[side]) for side in jaws}, poses=poses)


def _average(pixels: NDArray) -> NDArray:
    """Return the means (K, 2) of pixels (n, K, 2), NaN for a key point that is not seen in most images."""
    seen = np.isfinite(pixels).all(axis=2)
    sums = np.where(seen[:, :, None], pixels, 0.0).sum(axis=0)
    often = seen.mean(axis=0) > _OFTEN
    return np.where(often[:, None], sums / np.maximum(seen.sum(axis=0), 1)[:, None], np.nan)
