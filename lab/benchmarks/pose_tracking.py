"""Follows rendered objects through 30 images a second and compares with their true poses; prints tables, writes JSON.

    python -m lab.benchmarks.pose_tracking [--json report/pose_tracking.json] [--frames 90] [--seeds 2]

Depths are those of a D405 in noise, edges, holes and rounding; the tracker gets no mask after the first image, the two
libraries that it is compared with get the true one. Times are those of one thread's processor.
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from itertools import islice
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from finforce.camera import CameraIntrinsics, deproject
from finforce.transforms import invert_pose, move_pose, rotation_between
from finforce_contact.errors import PoseLostError
from finforce_contact.mesh.triangles import ObjectMesh
from finforce_contact.mesh.views import MeshView
from finforce_contact.pose.source import ObjectPose
from finforce_contact.pose.tracker import PoseTracker
from finforce_eval.machine import write_figures
from finforce_sim.rendering.depth_camera import build_d405
from finforce_sim.scenes.objects import OBJECT_NAMES, build_object
from finforce_sim.scenes.pose_sequences import Motion, SequenceImage, render_sequence

STEPS = {"848x480": 1, "424x240": 2}
HIDDEN = (0.0, 0.3, 0.5)
SURE = np.array([0.002] * 3 + [np.deg2rad(4.0)] * 3)  # standard deviations below which a pose is called sure
FOUND = (0.003, np.deg2rad(4.0))  # a first pose no farther off is the right one
LIBRARIES = ("small_gicp", "open3d")
IN, LENGTH = 35, 60  # the image in which the plates of a sequence of so many images are in


@dataclass(frozen=True, kw_only=True)
class TrackingCase:
    """Which sequence, followed how."""

    name: str
    resolution: str
    hidden: float
    seed: int
    speed: float = 0.1
    method: str = "tracker"


@dataclass(frozen=True, kw_only=True)
class TrackedPose:
    """One image: errors [mm, deg], turn about the axis since the first image [deg], sure or not, time [ms]."""

    translation: float
    rotation: float
    spin: float
    sure: bool
    milliseconds: float


class MaskFree:
    """`PoseTracker` behind the methods of `IcpTracker`."""

    def __init__(self, mesh: ObjectMesh, camera: CameraIntrinsics) -> None:
        """Prepares the mesh."""
        self.tracker = PoseTracker(mesh, camera)

    def locate(self, frame: SequenceImage, guess: NDArray) -> ObjectPose:
        """Starts with a mask and a guess (4, 4)."""
        return self.tracker.locate(frame.stamp, frame.depth, frame.mask, [guess])

    def track(self, frame: SequenceImage) -> ObjectPose:
        """Follows without a mask."""
        return self.tracker.track(frame.stamp, frame.depth)


def follow(case: TrackingCase, frames: int) -> dict:
    """Returns the figures of one sequence: its samples, and how often the object was lost and found again."""
    mesh, camera = build_object(case.name), build_d405(step=STEPS[case.resolution])
    motion = Motion(
        speed=case.speed, turn_rate=np.deg2rad(300.0 * case.speed), hidden=case.hidden, frames=frames
    )  # at 0.1 m/s, 30 deg/s
    method = (
        MaskFree(mesh, camera) if case.method == "tracker" else IcpTracker(mesh, camera, import_module(case.method))
    )
    samples, lost, turn, before = [], 0, 0.0, None
    for frame in render_sequence(mesh, camera, motion, case.seed):
        began = time.thread_time()
        try:
            pose = method.track(frame) if before is not None else method.locate(frame, _disturb(frame, case.seed))
        except PoseLostError:
            lost += 1
            continue
        spent = time.thread_time() - began
        T = pose.T_camera_object
        turn += 0.0 if before is None else Rotation.from_matrix(before[:3, :3].T @ T[:3, :3]).as_rotvec()[2]
        off = compute_deviation(case.name, frame, T, camera)
        sure = _is_sure(case.name, pose)
        if before is not None:
            samples.append(
                TrackedPose(
                    translation=1e3 * off.translation,
                    rotation=float(np.rad2deg(off.rotation)),
                    spin=float(np.rad2deg(turn)),
                    sure=sure,
                    milliseconds=1e3 * spent,
                )
            )
        before = T
    recovered = method.tracker.counts.get("recovered", 0) if case.method == "tracker" else 0
    return {"samples": samples, "lost": lost, "recovered": recovered}


def summarize(followed: Sequence[dict]) -> dict:
    """Returns the figures of several sequences together."""
    samples = [sample for one in followed for sample in one["samples"]]
    sure = [sample for sample in samples if sample.sure]
    return {
        "n": len(samples),
        "translation_mm": _quantiles([sample.translation for sample in samples]),
        "rotation_deg": _quantiles([sample.rotation for sample in samples]),
        "sure_share": len(sure) / max(len(samples), 1),
        "sure_translation_mm": _quantiles([sample.translation for sample in sure]),
        "sure_rotation_deg": _quantiles([sample.rotation for sample in sure]),
        "spin_deg": max((abs(sample.spin) for sample in samples), default=0.0),
        "cpu_ms": _quantiles([sample.milliseconds for sample in samples]),
        "lost": sum(one["lost"] for one in followed),
        "recovered": sum(one["recovered"] for one in followed),
    }


def locate_all(count: int) -> dict:
    """Returns, for each object, how often the first pose without any guess is the right one, and its time [s].

    Plates hide 30 % of the object in every second image.
    """
    figures, camera = {}, build_d405(step=2)
    for name in tqdm(OBJECT_NAMES, desc="first poses", leave=False):
        mesh, right, seconds, hidden = build_object(name), 0, [], []
        for seed in range(count):
            images = render_sequence(mesh, camera, Motion(hidden=0.3 * (seed % 2), frames=LENGTH), 100 + seed)
            frame = next(islice(images, IN, None))
            hidden.append(frame.hidden)
            tracker, began = PoseTracker(mesh, camera), time.thread_time()
            try:
                off = compute_deviation(
                    name, frame, tracker.locate(frame.stamp, frame.depth, frame.mask).T_camera_object, camera
                )
                right += off.translation < FOUND[0] and off.rotation < FOUND[1]
            except PoseLostError:
                pass
            seconds.append(time.thread_time() - began)
        figures[name] = {"n": count, "right": int(right), "hidden": hidden, "cpu_s": _quantiles(seconds)}
    return figures


def run(frames: int, seeds: int) -> dict:
    """Returns the figures of every case."""
    plan: dict[str, list[TrackingCase]] = {}
    for resolution in STEPS:
        for hidden in HIDDEN:
            for name in OBJECT_NAMES:
                plan[f"{name} {resolution} hidden {hidden:.0%}"] = [
                    TrackingCase(name=name, resolution=resolution, hidden=hidden, seed=seed) for seed in range(seeds)
                ]
    for name in OBJECT_NAMES:
        plan[f"{name} 424x240 0.3 m/s 90 deg/s"] = [
            TrackingCase(name=name, resolution="424x240", hidden=0.0, seed=seed, speed=0.3) for seed in range(seeds)
        ]
    for library in find_libraries():
        for hidden in (0.0, 0.5):
            plan[f"{library}, true mask, 424x240 hidden {hidden:.0%}"] = [
                TrackingCase(name=name, resolution="424x240", hidden=hidden, seed=0, method=library)
                for name in OBJECT_NAMES
            ]
    figures, every = {}, {resolution: [] for resolution in STEPS}
    for title, cases in tqdm(plan.items(), desc="sequences", leave=False):
        followed = [follow(case, frames) for case in cases]
        figures[title] = summarize(followed) | {"cases": [asdict(case) for case in cases]}
        if cases[0].method == "tracker" and cases[0].speed == TrackingCase.speed:
            every[cases[0].resolution] += followed
    return figures | {f"all {resolution}": summarize(followed) for resolution, followed in every.items()}


def find_libraries() -> list[str]:
    """Returns the libraries to compare with that are installed, and prints what is left out."""
    found = []
    for name in LIBRARIES:
        try:
            import_module(name)
        except ImportError as error:
            print(f"{name} is left out: {error}; pip install {name}")
        else:
            found.append(name)
    return found


def _is_sure(name: str, pose: ObjectPose) -> bool:
    covariance = pose.covariance.copy()
    if name in ROUND:  # what the axis turns by itself counts for nothing
        axis = pose.T_camera_object[:3, 2]
        across = np.eye(3) - np.outer(axis, axis)
        covariance[3:, 3:] = across @ covariance[3:, 3:] @ across
    return bool((np.sqrt(np.diag(covariance)) < SURE).all())


def _disturb(frame: SequenceImage, seed: int) -> NDArray:
    rng = np.random.default_rng(seed)
    return move_pose(frame.T_camera_object, np.concatenate([rng.normal(0.0, 2e-3, 3), rng.normal(0.0, 0.03, 3)]))


def _quantiles(values: Sequence[float]) -> dict[str, float]:
    if not len(values):
        return dict.fromkeys(("median", "p95", "p99", "max"), float("nan"))
    p50, p95, p99 = np.quantile(values, (0.5, 0.95, 0.99))
    return {"median": float(p50), "p95": float(p95), "p99": float(p99), "max": float(np.max(values))}


def format_table(figures: dict) -> str:
    """Returns a row for each case; translations in mm, rotations in degrees, processor time in ms."""
    head = f"{'':44s}   n   t p50   p95   r p50   p95 | sure  t p95  r p95 | spin lost rec. | ms p50  p95   Hz"
    rows = [head]
    for title, one in figures.items():
        t, r, ms = one["translation_mm"], one["rotation_deg"], one["cpu_ms"]
        st, sr = one["sure_translation_mm"], one["sure_rotation_deg"]
        spin = f"{one['spin_deg']:5.1f}" if title.split()[0] in ROUND else "     "
        rows.append(
            f"{title:44s}{one['n']:5d}  {t['median']:5.2f} {t['p95']:6.2f}  {r['median']:5.2f} {r['p95']:6.2f} | "
            f"{one['sure_share']:4.0%}  {st['p95']:5.2f}  {sr['p95']:5.2f} |{spin} {one['lost']:4d} "
            f"{one['recovered']:4d} | {ms['median']:5.1f} {ms['p95']:5.1f} {1e3 / ms['median']:4.0f}"
        )
    return "\n".join(rows)


def main() -> None:
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    parser.add_argument("--frames", type=int, default=90, help="images of each sequence")
    parser.add_argument("--seeds", type=int, default=2, help="sequences of each case")
    parser.add_argument("--starts", type=int, default=10, help="first poses of each object")
    options = parser.parse_args()
    figures, starts = run(options.frames, options.seeds), locate_all(options.starts)
    print(format_table(figures))
    for name, one in starts.items():
        hidden = f"hidden {min(one['hidden']):.0%} to {max(one['hidden']):.0%}"
        print(f"first pose of {name}: {one['right']} of {one['n']} right, {hidden}, {one['cpu_s']['median']:.2f} s")
    if options.json:
        write_figures(options.json, {"tracking": figures, "first_poses": starts})


ROUND = ("cylinder", "bottle")
HANDLE_RADIUS, HANDLE_SHARE = 0.042, 0.015  # the mug's body ends within; fewer of its pixels say nothing of its turn
POINTS = 1000
REACH = 0.01  # [m] between corresponding points


@dataclass(frozen=True, kw_only=True)
class PoseDeviation:
    """What a pose is off: translation [m], and rotation [rad] beyond what the object's symmetry leaves open."""

    translation: float
    rotation: float


class IcpTracker:
    """The visible part of the mesh against the masked points, frame to frame, by small_gicp or Open3D."""

    def __init__(self, mesh: ObjectMesh, camera: CameraIntrinsics, library: ModuleType) -> None:
        """Prepares the mesh; the library is small_gicp (GICP) or open3d (point to plane)."""
        self._view, self._camera, self._library = MeshView(mesh), camera, library
        self._T: NDArray | None = None

    def locate(self, frame: SequenceImage, guess: NDArray) -> ObjectPose:
        """Starts from a guess (4, 4)."""
        self._T = guess
        return self.track(frame)

    def track(self, frame: SequenceImage) -> ObjectPose:
        """Follows the object by the points within the frame's mask, which is the true one."""
        step = max(1, int(np.sqrt(frame.mask.sum() / POINTS)))
        chosen = np.zeros_like(frame.mask)
        chosen[::step, ::step] = frame.mask[::step, ::step]
        measured = deproject(frame.depth, self._camera, chosen)
        view = self._view.render(self._T, self._camera, step)
        if min(len(measured), len(view.points)) < 30:
            raise PoseLostError("too few points")
        align = _align_gicp if self._library.__name__ == "small_gicp" else _align_open3d
        self._T = align(self._library, view, measured) @ self._T
        return ObjectPose(
            stamp=frame.stamp, T_camera_object=self._T, covariance=np.eye(6) * 1e-6, fitness=1.0, source="icp"
        )


def compute_deviation(name: str, frame: SequenceImage, T: NDArray, camera: CameraIntrinsics) -> PoseDeviation:
    """Returns what a pose (4, 4) of an object is off.

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


def _shows_handle(frame: SequenceImage, camera: CameraIntrinsics) -> bool:
    back = invert_pose(frame.T_camera_object)
    points = deproject(frame.depth, camera, frame.mask) @ back[:3, :3].T + back[:3, 3]
    outside = np.hypot(points[:, 0], points[:, 1]) > HANDLE_RADIUS
    return bool((outside & (np.abs(points) < 0.08).all(axis=1)).mean() > HANDLE_SHARE)


def _align_gicp(small_gicp, view, measured: NDArray) -> NDArray:
    """Returns the motion (4, 4) of the mesh onto the measured points."""
    found = small_gicp.align(
        measured, view.points, registration_type="GICP", downsampling_resolution=1e-4,
        max_correspondence_distance=REACH, num_threads=1,
    )  # fmt: skip
    return np.asarray(found.T_target_source)


def _align_open3d(open3d, view, measured: NDArray) -> NDArray:
    """Returns the motion (4, 4) of the mesh onto the measured points; planes are those of the mesh."""
    clouds = [open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)) for points in (measured, view.points)]
    clouds[1].normals = open3d.utility.Vector3dVector(view.normals)
    registration = open3d.pipelines.registration
    found = registration.registration_icp(
        clouds[0], clouds[1], REACH, np.eye(4), registration.TransformationEstimationPointToPlane()
    )
    return invert_pose(found.transformation)


if __name__ == "__main__":
    main()
