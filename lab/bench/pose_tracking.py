"""The pose tracker on rendered objects, 30 images a second, against their true poses.

Depths are those of a D405 in noise, edges, holes and rounding; the tracker gets no mask after the first image. Times
are those of one thread's processor.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import islice, product
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from finforce.camera import CameraIntrinsics, deproject
from finforce.transforms import invert_pose, move_pose, rotation_between
from finforce_contact.errors import PoseLostError
from finforce_contact.pose.tracker import ObjectPose, PoseTracker
from finforce_sim.objects import OBJECT_NAMES, build_object
from finforce_sim.sensor import build_d405
from lab.harness import Figures
from lab.table_scenes import Motion, SequenceImage, render_sequence

STEPS = {"848x480": 1, "424x240": 2}
HIDDEN = (0.0, 0.3, 0.5)
SPEED, FAST = 0.1, 0.3  # [m/s], with 30 and 90 deg/s
FRAMES = 90
STARTS = 10  # first poses of each object
SURE = np.array([0.002] * 3 + [np.deg2rad(4.0)] * 3)  # standard deviations below which a pose is called sure
FOUND = (0.003, np.deg2rad(4.0))  # a first pose no farther off is the right one
IN, LENGTH = 35, 60  # the image in which the plates of a sequence of so many images are in
ROUND = ("cylinder", "bottle")
HANDLE_RADIUS, HANDLE_SHARE = 0.042, 0.015  # the mug's body ends within; fewer of its pixels say nothing of its turn


def measure(quick: bool, count: int = 2) -> Figures:
    """Return errors, losses and times of the tracker, and how often its first pose is the right one.

    Args:
        quick: one short sequence of each object, in the coarse camera with nothing hidden, and one first pose.
        count: sequences of each case.
    """
    cases = [(size, hidden, SPEED) for size, hidden in product(STEPS, HIDDEN)] + [("424x240", 0.0, FAST)]
    cases, seeds, frames = ([cases[3]], range(1), 20) if quick else (cases, range(count), FRAMES)
    plan = list(product(OBJECT_NAMES, cases, seeds))
    samples = pd.concat(
        [
            follow(name, *case, seed, frames)
            for name, case, seed in tqdm(plan, desc="sequences", disable=None, leave=False)
        ]
    )
    starts = [
        locate(name, 1 if quick else STARTS) for name in tqdm(OBJECT_NAMES, unit="object", disable=None, leave=False)
    ]
    return Figures(tables={"tracking": summarise(samples), "first_poses": pd.DataFrame(starts)})


@dataclass(frozen=True, kw_only=True)
class PoseDeviation:
    """What a pose is off: translation [m], and rotation [rad] beyond what the object's symmetry leaves open."""

    translation: float
    rotation: float


def follow(name: str, size: str, hidden: float, speed: float, seed: int, frames: int) -> pd.DataFrame:
    """Return a row for each image after the first of a sequence; errors are NaN where the object was lost."""
    mesh, camera = build_object(name), build_d405(step=STEPS[size])
    motion = Motion(speed=speed, turn_rate=np.deg2rad(300.0 * speed), hidden=hidden, frames=frames)
    tracker, about = PoseTracker(mesh, camera), {"object": name, "image": size, "hidden": hidden, "speed/m/s": speed}
    rows, turn, before = [], 0.0, None
    for frame in render_sequence(mesh, camera, motion, seed):
        began = time.thread_time()
        try:
            if before is None:
                pose = tracker.locate(frame.stamp, frame.depth, frame.mask, [_disturb(frame, seed)])
            else:
                pose = tracker.track(frame.stamp, frame.depth)
        except PoseLostError:
            rows.append({**about, "lost": 1})
            continue
        spent, T = time.thread_time() - began, pose.T_camera_object
        if before is not None:
            turn += Rotation.from_matrix(before[:3, :3].T @ T[:3, :3]).as_rotvec()[2]
            off = compute_deviation(name, frame, T, camera)
            rows.append(
                {
                    **about,
                    "translation/mm": 1e3 * off.translation,
                    "rotation/deg": float(np.rad2deg(off.rotation)),
                    "spin/deg": abs(float(np.rad2deg(turn))),
                    "sure": is_sure(name, pose),
                    "CPU/ms": 1e3 * spent,
                    "lost": 0,
                }
            )
        before = T
    found = pd.DataFrame(rows)
    found["recovered"] = tracker.counts.get("recovered", 0) / len(found)
    return found


def summarise(samples: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each object, image size, hidden share and speed, and one for all objects of each size."""
    keys = ["object", "image", "hidden", "speed/m/s"]
    groups = list(samples.groupby(keys, sort=False))
    usual = samples[samples["speed/m/s"] == SPEED]
    groups += [(("all", size, np.nan, SPEED), own) for size, own in usual.groupby("image", sort=False)]
    rows = []
    for key, own in groups:
        seen = own[own["lost"] == 0]
        sure = seen[seen["sure"].astype(bool)]
        row: dict[str, Any] = {**dict(zip(keys, key, strict=True)), "n": len(seen), "lost": int(own["lost"].sum())}
        row["recovered"] = round(own["recovered"].sum())
        for column in ("translation/mm", "rotation/deg", "CPU/ms"):
            what, unit = column.split("/")
            row |= {f"{what} {q}/{unit}": seen[column].quantile(share) for q, share in (("p50", 0.5), ("p95", 0.95))}
        row["sure/%"] = 100.0 * len(sure) / max(len(seen), 1)
        row |= {f"sure {column} p95": sure[column].quantile(0.95) for column in ("translation/mm", "rotation/deg")}
        rows.append(row | {"spin/deg": seen["spin/deg"].max() if key[0] in ROUND else np.nan})
    return pd.DataFrame(rows)


def locate(name: str, count: int) -> dict[str, Any]:
    """Return how often the first pose of an object without any guess is the right one.

    Plates hide 30 % of the object in every second image.
    """
    mesh, camera, right, seconds = build_object(name), build_d405(step=2), 0, []
    for seed in range(count):
        images = render_sequence(mesh, camera, Motion(hidden=0.3 * (seed % 2), frames=LENGTH), 100 + seed)
        frame = next(islice(images, IN, None))
        tracker, began = PoseTracker(mesh, camera), time.thread_time()
        try:
            pose = tracker.locate(frame.stamp, frame.depth, frame.mask)
            off = compute_deviation(name, frame, pose.T_camera_object, camera)
            right += off.translation < FOUND[0] and off.rotation < FOUND[1]
        except PoseLostError:
            pass
        seconds.append(time.thread_time() - began)
    return {"first pose of": name, "n": count, "right": int(right), "CPU/s": float(np.median(seconds))}


def is_sure(name: str, pose: ObjectPose) -> bool:
    """Return whether the stated deviations are small, of round objects without what they turn by about their axis."""
    covariance = pose.covariance.copy()
    if name in ROUND:
        axis = pose.T_camera_object[:3, 2]
        across = np.eye(3) - np.outer(axis, axis)
        covariance[3:, 3:] = across @ covariance[3:, 3:] @ across
    return bool((np.sqrt(np.diag(covariance)) < SURE).all())


def compute_deviation(name: str, frame: SequenceImage, T: NDArray, camera: CameraIntrinsics) -> PoseDeviation:
    """Return what a pose (4, 4) of an object is off.

    Of round objects, and of the mug while less than 1.5 % of its seen pixels are handle, the tilt of the axis counts;
    of the cube, the nearest of the turns that map it onto itself.
    """
    true = frame.T_camera_object
    tilt = float(np.arccos(np.clip(true[:3, 2] @ T[:3, 2], -1.0, 1.0)))
    if name == "cylinder":
        rotation = min(tilt, np.pi - tilt)
    elif name in ROUND or (name == "mug" and not _shows_handle(frame, camera)):
        rotation = tilt
    elif name == "cube":
        turned = [T[:3, :3] @ turn for turn in Rotation.create_group("O").as_matrix()]
        rotation = min(rotation_between(true, turn) for turn in turned)
    else:
        rotation = rotation_between(true, T)
    return PoseDeviation(translation=float(np.linalg.norm(T[:3, 3] - true[:3, 3])), rotation=rotation)


def _disturb(frame: SequenceImage, seed: int) -> NDArray:
    """Return the true pose off by 2 mm and 0.03 rad about each axis (standard deviations)."""
    rng = np.random.default_rng(seed)
    return move_pose(frame.T_camera_object, np.concatenate([rng.normal(0.0, 2e-3, 3), rng.normal(0.0, 0.03, 3)]))


def _shows_handle(frame: SequenceImage, camera: CameraIntrinsics) -> bool:
    """Return whether the mug's handle is seen well enough to tell its turn."""
    back = invert_pose(frame.T_camera_object)
    points = deproject(frame.depth, camera, frame.mask) @ back[:3, :3].T + back[:3, 3]
    outside = np.hypot(points[:, 0], points[:, 1]) > HANDLE_RADIUS
    return bool((outside & (np.abs(points) < 0.08).all(axis=1)).mean() > HANDLE_SHARE)
