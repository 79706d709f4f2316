"""From the start of a slip to its alarm, and false alarms at rest, by the rate and the noise of an object's poses.

    python -m lab.benchmarks.slip [--images N] [--json report/slip.json]

Poses of an object that rests on a jaw and, from a random moment on, slides along it at 5 mm/s; white noise on all
three axes. With `--images`, N seeds of rendered grasps: an object that a hand draws along the fingers at 5 mm/s, one
that slides by its own weight, one that is held. Key points, jaw poses and object poses are found in the images, the
latter by the pose tracker.
"""

import argparse
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from finforce.gripper_frames import ROBOT_CAMERA, SIDES
from finforce.stamps import SECOND
from finforce.transforms import pose_numbers
from finforce_contact.estimator import ContactEstimator
from finforce_contact.jaw_contact import ForceLoop
from finforce_contact.localization.slip import SlipWatch, TouchedFace
from finforce_contact.mesh.views import MeshView
from finforce_contact.pose.tracker import PoseTracker
from finforce_contact.settings import ContactSettings
from finforce_eval.evaluation.keypoint_source import build_records
from finforce_eval.machine import write_json
from finforce_ifea.estimator import JawEstimator
from finforce_ifea.jaw.calibration import load_calibration
from finforce_ifea.settings import EstimatorSettings
from finforce_keypoints.build import build_detector
from finforce_keypoints.detector import JawKeypoints
from finforce_keypoints.images import RgbdImage
from finforce_keypoints.parameters import load_jaws
from finforce_sim.gripper.footage import Footage, set_stage
from finforce_sim.gripper.gripper import TwinGripper, TwinState
from finforce_sim.rendering.depth_camera import build_d405_vga
from finforce_sim.rendering.photographer import Photographer
from finforce_sim.scenes.scenarios import build_scenario
from lab.experiments.grasp_sensors import observe_found
from lab.experiments.tracked_poses import find_pose

FACE = TouchedFace(point=np.array([0.012, 0.0, 0.040]), tangent=np.array([0.0, 0.0, 1.0]))
SPEED, BEGIN = 5e-3, 4.0
# Rate [Hz] and noise of each axis [m].
CASES = ((30.0, 0.1e-3), (30.0, 0.2e-3), (30.0, 0.4e-3), (90.0, 0.2e-3), (10.0, 0.3e-3))
SLIPS, MINUTES = 40, 10


def watch(rate: float, noise: float, begin: float, end: float, seed: int) -> list[tuple[float, bool]]:
    """Returns stamp [s] and whether the object is said to slide, pose after pose."""
    random, eyes = np.random.default_rng(seed), SlipWatch(ContactSettings())
    eyes.place(0.040)
    said = []
    for stamp in np.arange(0.0, end, 1.0 / rate):
        T = np.eye(4)
        T[:3, 3] = np.array([0.03, 0.0, 0.04 + SPEED * max(0.0, stamp - begin)]) + noise * random.standard_normal(3)
        said.append((stamp, eyes.update(stamp, T, FACE).sliding))
    return said


def measure(rate: float, noise: float) -> dict[str, float]:
    """Returns delays [ms] of slips, missed ones infinite, and false alarms per minute."""
    delays, alarms = [], 0
    for seed in range(SLIPS):
        begin = BEGIN + 0.37 * seed / 20
        said = watch(rate, noise, begin, 6.0, seed)
        delays.append(next((1e3 * (stamp - begin) for stamp, slides in said if slides and stamp > begin), np.inf))
    for seed in range(MINUTES // 2):
        slides = [now for _, now in watch(rate, noise, np.inf, 120.0, 100 + seed)]
        alarms += sum(now and not before for before, now in zip(slides, slides[1:], strict=False))
    middle, slow = np.percentile(delays, [50, 90])
    return {"delay_p50_ms": float(middle), "delay_p90_ms": float(slow), "false_alarms_per_minute": alarms / MINUTES}


# Rendered scenes with what is changed in them.
SCENES = {
    "drawn at 5 mm/s": ("shifting", {"slide": 0.0075, "shift_time": 1.5, "record": 1.5}),
    "heavy": ("slipping", {"record": 1.5}),
    "held": ("hold", {"record": 15.0}),
}
# [m] by which a depth may be off a mesh whose pixel it is, and [m/s] beyond which an object truly slides.
ON_MESH, SLIDES = 8e-3, 1.5e-3


class Seen(NamedTuple):
    """One image: stamp [s], whether the object truly slides, whether a jaw says so, error of the object's pose [m]."""

    stamp: float
    slides: bool
    said: bool
    error: float


class Witness:
    """A gripper that keeps the last state that it gave."""

    def __init__(self, gripper: TwinGripper) -> None:
        """Takes the gripper."""
        self._gripper, self.state = gripper, None

    def __len__(self) -> int:
        """Returns the number of states."""
        return len(self._gripper)

    def states(self) -> Iterator[TwinState]:
        """Yields the states."""
        for state in self._gripper.states():
            self.state = state
            yield state


def watch_images(scene: str, seed: int) -> Iterator[Seen]:
    """Yields what is said of one rendered grasp, image by image."""
    name, changes = SCENES[scene]
    scenario, camera = build_scenario(name, **changes), build_d405_vga()
    gripper = TwinGripper(scenario, 0)
    witness, stage = Witness(gripper), set_stage(gripper, camera, 1e-3)
    footage = Footage(witness, Photographer(stage, seed), stage, seed)
    given = {"jaws": "both", "jaw_file": scenario.jaw, "T_gripper_camera": list(pose_numbers(ROBOT_CAMERA))}
    parameters, settings, dots = build_records(given)
    jaws = load_jaws(parameters)
    detector = build_detector(jaws, parameters, settings, dots).detector
    calibration = load_calibration("twin")
    loops = {}
    for side in SIDES:
        force = JawEstimator(jaws[side], settings=EstimatorSettings(held="yes"), calibration=calibration)
        loops[side] = ForceLoop(ContactEstimator(force.jaw, mesh=stage.mesh), force)
    tracker, view, before = PoseTracker(stage.mesh, camera), MeshView(stage.mesh), None
    for frame in footage:
        T = np.linalg.inv(ROBOT_CAMERA) @ witness.state.T_gripper_object
        stamp = frame.stamp * SECOND
        image = RgbdImage(stamp=stamp, color=frame.color, depth=frame.depth, camera=camera)
        found, pose = detector.detect(image), find_pose(tracker, view, image, T, ON_MESH)
        said = [_said(loops[side], stamp, keypoints, pose) for side, keypoints in found.items()]
        height = witness.state.T_gripper_object[2, 3]
        slides = before is not None and abs(height - before) * 30.0 > SLIDES
        error = np.inf if pose is None else float(np.linalg.norm(pose[:3, 3] - T[:3, 3]))
        before = height
        yield Seen(stamp, slides, any(said), error)


def _said(loop: ForceLoop, stamp: float, keypoints: JawKeypoints, pose: NDArray | None) -> bool:
    """Returns whether a jaw's object is said to slide."""
    poses = [] if pose is None else [(stamp, np.linalg.inv(keypoints.T_camera_jaw) @ pose)]
    loop.update(observe_found(stamp, keypoints), poses)
    last = loop.contact.last
    slip = None if last is None else last.estimate.slip
    return slip is not None and slip.sliding


def measure_images(scene: str, seeds: int) -> dict[str, float | None]:
    """Returns delays [ms] of the slips' starts, None without slips, and how many false alarms there were."""
    delays, alarms, minutes, errors = [], 0, 0.0, []
    for seed in range(seeds):
        seen = list(tqdm(watch_images(scene, seed), desc=f"{scene} {seed}", unit="image", leave=False, disable=None))
        errors += [one.error for one in seen]
        for i in range(1, len(seen)):
            if seen[i].slides and not any(one.slides for one in seen[max(0, i - 10) : i]):
                later = next((one.stamp for one in seen[i:] if one.said), np.inf)
                delays.append(1e3 * (later - seen[i - 1].stamp))
            # an alarm may outlast its slip by a little
            near = any(one.slides for one in seen[max(0, i - 20) : i + 1])
            alarms += seen[i].said and not seen[i - 1].said and not near
        minutes += sum(not one.slides for one in seen) / 30.0 / 60.0
    middle, slow = np.percentile(delays, [50, 90], method="higher").tolist() if delays else (None, None)
    return {
        "slips": len(delays),
        "delay_p50_ms": middle,
        "delay_p90_ms": slow,
        "false_alarms": alarms,
        "minutes": minutes,
        "pose_error_p50_mm": 1e3 * float(np.median(errors)),
    }


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", metavar="OUT", help="write the figures as JSON")
    parser.add_argument("--images", type=int, default=0, metavar="N", help="seeds of each rendered scene (0)")
    options = parser.parse_args()
    found = {}
    print("poses            delay, median / 90 %   false alarms per minute")
    for rate, noise in CASES:
        case = measure(rate, noise)
        found[f"{rate:g} Hz, {1e3 * noise:g} mm"] = case
        times = f"{case['delay_p50_ms']:.0f} / {case['delay_p90_ms']:.0f} ms"
        print(f"{rate:3.0f} Hz, {1e3 * noise:.1f} mm   {times:>20}   {case['false_alarms_per_minute']:.1f}")
    for scene in SCENES if options.images else ():
        case = found[scene] = measure_images(scene, options.images)
        times = f"{case['delay_p50_ms']:.0f} / {case['delay_p90_ms']:.0f} ms, " if case["slips"] else ""
        print(
            f"images, {scene}: {times}{case['slips']} slips, {case['false_alarms']} false alarms in "
            f"{case['minutes']:.1f} minutes without one, poses off by {case['pose_error_p50_mm']:.2f} mm"
        )
    if options.json:
        write_json(options.json, found)


if __name__ == "__main__":
    main()
