"""What poses of the object are worth as they come: late, with gaps, and with flips of things that look alike turned."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from finforce.transforms import pose_from_quaternion, quaternion_from_pose
from finforce_contact.errors import PoseLostError
from finforce_contact.mesh.object_mesh import load_object_mesh
from finforce_contact.mesh.views import MeshView
from finforce_contact.pose.tracker import PoseTracker
from finforce_eval.errors import RecordingError
from finforce_eval.evaluate import evaluate_all
from finforce_eval.evaluation.contact_source import ContactChoice
from finforce_eval.recordings.objects import require_mesh
from finforce_eval.recordings.tracks import PoseTrack, Recording
from finforce_keypoints.images import RgbdImage
from lab.experiments.experiment import SHARP, Case, Experiment, RunOptions, axis_sharpness, build_setup, keep_poses
from lab.experiments.grasp import join_jaws, score_grasp
from lab.harness import Figures

SCENES = {
    "cylinder": ("grasp_cylinder", {}),
    "cube": ("grasp_cube", {}),
    "asymmetric": ("grasp_asymmetric", {}),
    "fast": ("fast_close", {"cycles": 1}),
    "drawn": ("shifting", {}),
    "rocked": ("rocking", {}),
}
QUICK_SCENES = ("asymmetric",)
MILLISECOND = 1_000_000  # [ns]
DELAYS = {"on time": 0, "100 ms late": 100 * MILLISECOND, "200 ms late": 200 * MILLISECOND}
FLIPPED = 0.1  # share of the poses that are turned
GAP, GAPS_EVERY = 0.8, 2.0  # [s] without poses, and from one such gap to the next
WORST, TRACKER = "200 ms late, flips, gaps", "built-in tracker"
EACH = "Each grasp, RMSE [N]"
NOTE = "Grasp force: mean over the grasps of each one's RMSE while the true force is above 0.02 N."
ON_MESH = 4e-3  # [m] within which a pixel's depth is that of the object, for the first pose
FIRST_WITHIN = 50_000_000  # [ns] between the first pose that is known and an image
NANOSECOND = 1e-9


def flip_poses(recording: Recording, seed: int) -> Recording:
    """Return a recording in which some poses of the object are turned by half a turn about one of its axes."""
    track, rng = recording.object_pose, np.random.default_rng(seed)
    turned = rng.random(len(track.stamps)) < FLIPPED
    axes = np.eye(3)[rng.integers(3, size=len(turned))]
    turns = Rotation.from_rotvec(np.pi * turned[:, None] * axes)
    quaternion = (Rotation.from_quat(track.quaternion) * turns).as_quat()
    return replace(recording, object_pose=replace(track, quaternion=quaternion))


def drop_poses(recording: Recording) -> Recording:
    """Return a recording whose object is lost for a while now and then."""
    stamps = recording.object_pose.stamps
    seconds = 1e-9 * (stamps - stamps[0])
    return keep_poses(recording, np.mod(seconds, GAPS_EVERY) < GAPS_EVERY - GAP)


def list_cases(options: RunOptions) -> Sequence[Case]:
    """Return the grasps."""
    if options.bags:
        return options.bag_cases()
    names = QUICK_SCENES if options.quick else tuple(SCENES)
    numbers = {name: number for number, name in enumerate(SCENES)}
    return [options.scene_case(name, *SCENES[name], numbers[name]) for name in names]


def run(options: RunOptions, case: Case, folder: Path) -> dict[str, Any]:
    """Return the figures of a grasp in each way."""
    with options.open_case(case, folder) as recording:
        flipped, lost = flip_poses(recording, options.seed), drop_poses(recording)
        ways = {name: (recording, delay) for name, delay in DELAYS.items()}
        ways |= {"flips": (flipped, 0), "gaps": (lost, 0), WORST: (drop_poses(flipped), DELAYS["200 ms late"])}
        found = {}
        if recording.images is not None and recording.images.has_depth:
            tracked = track_object(recording)
            ways[TRACKER] = (tracked.recording, tracked.delay)
        for way, (seen, delay) in ways.items():
            setup = build_setup(case.settings, ContactChoice(mode="estimate", pose_delay=delay))
            evaluation = evaluate_all([seen], setup)
            places = [score.solved_place["median_mm"] for score in evaluation.scores.values()]
            known = [place for place in places if place is not None]
            score = score_grasp(join_jaws(evaluation, recording.name))
            score |= {f"sharpness {axis}": value for axis, value in axis_sharpness(evaluation).items()}
            found[way] = {**score, "place_median_mm": max(known) if known else float("nan")}
    return {"ways": found}


def find(options: RunOptions, figures: Mapping[str, Mapping[str, Any]], folder: Path) -> Figures:
    """Return what each way adds to the error."""
    rows = [
        {"case": name, "poses": way, **one, "rmse_N": one["rmse_N"]["all"]}
        for name, row in figures.items()
        for way, one in row["ways"].items()
    ]
    scores = pd.json_normalize(rows, sep=" ")
    errors = scores.pivot(index="case", columns="poses", values="rmse_N").astype(float)
    errors = errors[scores.poses.unique()].dropna(axis=1)
    added, ways = errors.sub(errors["on time"], axis=0), scores.groupby("poses")
    summary = {
        "RMSE/N": errors.mean(),
        "added/N": added.mean(),
        "most added/N": added.max(),
        "place: worst median/mm": ways.place_median_mm.max(),
        "answered/%": ways.answered_pct.mean(),
        "within 3σ/%": ways.within_3_sigma_pct.mean(),
        **{heading: ways[column].mean() for column, heading in SHARP.items()},
    }
    by_way = pd.DataFrame(summary).loc[errors.columns].reset_index()
    return Figures(tables={"By way": by_way, EACH: errors.reset_index()}, notes=[NOTE])


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackedObject:
    """What the built-in tracker made of a recording's images.

    Attributes:
        recording: with its poses.
        delay: median time of an image [ns].
        lost: images in which the object was not found.
    """

    recording: Recording
    delay: int
    lost: int


def track_object(recording: Recording) -> TrackedObject:
    """Follow the object in a recording's depth images, from the first pose that the recording has.

    Raises:
        RecordingError: there are no depth images, or none near the first pose.
    """
    images = recording.images
    if images is None or not images.has_depth:
        raise RecordingError(f"{recording.name}: the built-in tracker needs depth images, which are not in it")
    mesh = load_object_mesh(require_mesh(recording))
    tracker, view = PoseTracker(mesh, images.camera), MeshView(mesh)
    known = recording.object_pose
    first = pose_from_quaternion(known.position[0], known.quaternion[0])
    stamps, poses, times, lost = [], [], [], 0
    for stamp, image in images.at(images.stamps[images.stamps >= known.stamps[0] - FIRST_WITHIN]):
        began = time.perf_counter()
        pose = find_pose(tracker, view, image, first, ON_MESH)
        if pose is None:
            lost += 1
            continue
        times.append(time.perf_counter() - began)
        stamps.append(stamp)
        poses.append(pose)
    if not stamps:
        raise RecordingError(f"{recording.name}: the built-in tracker did not find the object in {lost} depth images")
    track = PoseTrack(
        stamps=np.array(stamps, dtype=np.int64),
        position=np.array([T[:3, 3] for T in poses]),
        quaternion=np.array([quaternion_from_pose(T) for T in poses]),
        frame_id=images.frame_id,
    )
    return TrackedObject(
        recording=replace(recording, object_pose=track), delay=round(np.median(times) / NANOSECOND), lost=lost
    )


def find_pose(
    tracker: PoseTracker, view: MeshView, image: RgbdImage, T_first: NDArray, within: float
) -> NDArray | None:
    """Return T_camera_object (4, 4) in an image, None where the object is lost.

    Args:
        tracker: that has seen the images before.
        view: of the object.
        image: with depth.
        T_first: (4, 4) near which it is, as long as the tracker has no pose.
        within: depth by which a pixel may be off the mesh there and still be the object's [m].
    """
    try:
        if tracker.latest is not None:
            return tracker.track(image.stamp, image.depth).T_camera_object
        mask = np.abs(image.depth - view.render(T_first, image.camera).depth) < within
        return tracker.locate(image.stamp, image.depth, mask, [T_first]).T_camera_object
    except PoseLostError:
        return None


POSE = Experiment(
    name="pose",
    title="Poses of the object: late, flipped, lost",
    about=(
        "The paper takes the object's pose from FoundationPose, which is late, flips symmetric objects and sometimes "
        "loses them. Here the poses of the twin's tracker (10 Hz, 0.3 mm and 0.3° of noise) arrive 0, 100 and 200 ms "
        "after their image, a tenth of them is flipped, or they are missing for 0.8 s in every 2 s; the built-in "
        "tracker follows the object in the same depth images. The key points are detected once and are the same."
    ),
    list_cases=list_cases,
    run=run,
    find=find,
)
