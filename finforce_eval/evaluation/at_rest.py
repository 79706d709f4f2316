"""Images of jaws at rest: where their key points are in the mean, and where the detector takes the jaws to be."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.camera import EQUIDISTANT, PLUMB_BOB, CameraIntrinsics
from finforce.errors import FinforceError
from finforce.transforms import pose_numbers
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.keypoint_source import KeypointSource
from finforce_eval.recordings.tracks import Recording
from finforce_ifea.jaw.jaw import Jaw, load_jaw
from finforce_keypoints.detector import KeypointDetector
from finforce_keypoints.geometry.extrinsics import Extrinsics, SeenJaw, find_extrinsics

ROUNDS = 4  # of finding the key points with the camera pose found before
# [m]; a guess is allowed to be far off
LOOSE = {"detector.reference_tolerance": 0.02, "detector.largest_offset": 0.5, "detector.lost_images": 1000}
STILL = 0.05e-3  # [m] below which another round changes nothing
LENS_IMAGES, LESS = 10, 0.5  # images of another lens, and of what is left over, from which on it is that of the images
OFTEN = 0.5  # share of the images in which a jaw, and a key point, has to be seen


def first_images(recording: Recording, count: int) -> Recording:
    """Return a recording with its first images alone."""
    images = recording.images
    if images is None:
        raise RecordingError(f"{recording.name}: no images; record colour and camera_info, and aligned depth")
    if len(images) < count:
        raise RecordingError(f"{recording.name}: {len(images)} images, expected at least {count} of jaws at rest")
    return replace(recording, images=images.at(images.stamps_ns[:count]))


def doubt_intrinsics(camera: CameraIntrinsics) -> list[str]:
    """Return what speaks against the intrinsics of images, whatever these show."""
    doubts, aspect = [], camera.fx / camera.fy
    if not 0.97 < aspect < 1.03:
        doubts.append(f"fx / fy is {aspect:.3f}; expected 1: are the intrinsics those of another image size?")
    aside = np.hypot(camera.cx - 0.5 * (camera.width - 1), camera.cy - 0.5 * (camera.height - 1))
    turned = np.hypot(camera.cx - 0.5 * (camera.height - 1), camera.cy - 0.5 * (camera.width - 1))
    if aside > 0.1 * camera.width:
        likely = "turned by 90 degrees" if turned < 0.25 * aside else "cropped or scaled"
        doubts.append(
            f"principal point {aside:.0f} px off the middle, as in images of {2 * camera.cx + 1:.0f} x "
            f"{2 * camera.cy + 1:.0f}: was the image {likely}, but not the intrinsics?"
        )
    return doubts


@dataclass(frozen=True, kw_only=True, eq=False)
class JawsAtRest:
    """The key points that a detector saw.

    Attributes:
        jaws: by side.
        poses: where it took them to be, T_camera_jaw (4, 4) of every image by side.
        depth_ratio: measured depth over that of the jaws' places [-]; NaN where it is not known.
    """

    jaws: Mapping[str, SeenJaw]
    poses: Mapping[str, Sequence[NDArray]]
    depth_ratio: float


def average_at_rest(
    recording: Recording, detector: KeypointDetector, jaws: Mapping[str, Jaw], progress: Callable[[int], Any]
) -> JawsAtRest:
    """Average the pixels of the key points over the images.

    Raises:
        RecordingError: a jaw is found in less than half of them.
    """
    pixels: dict[str, list[NDArray]] = {side: [] for side in jaws}
    poses: dict[str, list[NDArray]] = {side: [] for side in jaws}
    for _, image in recording.images:
        for side, found in detector.detect(image).items():
            blind = np.isin(found.reasons, ("image", "likelihood"))[:, None]
            pixels[side].append(np.where(blind, np.nan, found.pixels))
            poses[side].append(found.T_camera_jaw)
        progress(1)
    for side, seen in pixels.items():
        if len(seen) < OFTEN * len(recording.images):
            told = (
                f"{recording.name}: the {side} jaw was found in {len(seen)} of {len(recording.images)} images: are the "
                "jaws in view and is the guess, --extrinsics, within some 10 mm and 5 degrees?"
            )
            raise RecordingError("; ".join((told, *doubt_intrinsics(recording.images.camera))))
    seen = {
        side: SeenJaw(points=jaw.keypoints, pixels=_average(np.array(pixels[side])), turn=detector.mounts[side].turn)
        for side, jaw in jaws.items()
    }
    return JawsAtRest(jaws=seen, poses=poses, depth_ratio=detector.depth_ratio)


def _average(pixels: NDArray) -> NDArray:
    """Return the means (K, 2) of pixels (n, K, 2), NaN for a key point that is not seen in most images."""
    seen = np.isfinite(pixels).all(axis=2)
    sums = np.where(seen[:, :, None], pixels, 0.0).sum(axis=0)
    often = seen.mean(axis=0) > OFTEN
    return np.where(often[:, None], sums / np.maximum(seen.sum(axis=0), 1)[:, None], np.nan)


def approach(
    recording: Recording,
    source: KeypointSource,
    jaws: Mapping[str, Jaw],
    guess: NDArray,
    progress: Callable[[int], Any] = lambda images: None,
) -> tuple[Extrinsics, JawsAtRest]:
    """Find the key points, with these the camera's pose, and again with that pose, until nothing moves.

    Args:
        recording: images of jaws at rest.
        source: the detector's parameters.
        jaws: by side.
        guess: T_gripper_camera (4, 4).
        progress: called with the number of images done since its last call, ROUNDS times as many at most.

    Raises:
        FinforceError: the jaws are not found, or a parameter cannot be used.
    """
    T = guess
    for _ in range(ROUNDS):
        here = replace(source, parameters={**LOOSE, **source.parameters, "T_gripper_camera": list(pose_numbers(T))})
        look = average_at_rest(recording, here.build(recording), jaws, progress)
        origins = [abs(float((T @ pose)[0, 3])) for poses in look.poses.values() for pose in poses]
        found = find_extrinsics(look.jaws, recording.images.camera, T, float(np.median(origins)))
        moved = float(np.linalg.norm(found.T_gripper_camera[:3, 3] - T[:3, 3]))
        T = found.T_gripper_camera
        if moved < STILL:
            break
    return found, look


def doubt_lens(found: Extrinsics, recording: Recording, source: KeypointSource, guess: NDArray) -> list[str]:
    """Return, in a sentence, that images do not have the distortion of their intrinsics; empty if they may have it.

    `found` is by these intrinsics, `guess` the T_gripper_camera (4, 4) that it began with; see `approach`.
    """
    images, camera = recording.images, recording.images.camera
    if camera.model != EQUIDISTANT and not camera.distortion.any():
        return []
    straight = replace(camera, model=PLUMB_BOB, distortion=np.zeros(0))
    first = replace(images.at(images.stamps_ns[:LENS_IMAGES]), camera=straight)
    jaws = {side: load_jaw(source.jaw_file, side) for side in recording.jaws}
    try:
        other, _ = approach(replace(recording, images=first), source, jaws, guess)
    except FinforceError:
        return []
    if other.residual > LESS * found.residual:
        return []
    return [
        f"{other.residual:.2f} px are left over without the distortion of the intrinsics ({camera.model}), "
        f"{found.residual:.2f} px with it: are the images rectified, or of another lens setting? give fx fy cx cy alone"
    ]
