"""Render grasps for the paper's baseline network, images and forces: `python -m lab.training.grasps FOLDER`.

The objects are those that the paper trains on, a cylinder and a cube, at 14 heights with five speeds, in bright light.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from finforce.optional import import_cv2
from finforce_eval.cli.parser import add_engine_options, read_engine, whole_number
from finforce_eval.tasks import Task
from finforce_sim.gripper import PressedGrasp, TwinState
from finforce_sim.scenarios import RATE, build_scenario
from finforce_sim.simulated_camera import SimulatedCamera
from finforce_sim.simulated_recording import parse_size
from lab.training.commands import TrainingError, one_line_errors
from lab.training.pictures import make_all

SCENES = ("grasp_cylinder", "grasp_cube")
HEIGHTS = np.linspace(0.022, 0.060, 14)  # [m] of the object's middle, as many as the paper's
SPEEDS = (0.004, 0.008, 0.012, 0.020, 0.030)  # [m/s] of each jaw, as many as the paper's
FORCES = (1.0, 4.6)  # [N], range of the elastic force at the end of closing
CLEARANCE = (0.0005, 0.003)  # [m], range of each open jaw's distance from first touch
HELD = (0.1, 0.4)  # [s], range of the time for which an object is held
OPEN = 0.15  # [s] for which the jaws stand open before and after
SIZE = "144x108"  # of the rendered images
EDGE = 96  # [px] of the network's square images
FIRST_SEED = 50_000  # of the grasps; the experiments' are from 100 on
STEP = 1e-3  # [m] of each jaw between two solved grasps


@dataclass(frozen=True, kw_only=True, eq=False)
class GraspImages:
    """The images of some grasps one after the other.

    Attributes:
        images: (n, EDGE, EDGE, 3) uint8 RGB at 30 Hz.
        force: (n,) min(|F_left|, |F_right|) [N].
        starts: (m + 1,) rows at which grasps begin, and n.
    """

    images: NDArray
    force: NDArray
    starts: NDArray


def shrink_image(color: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the middle square of an image (h, w, 3), which shows both jaws, as the network sees it."""
    height, width = color.shape[:2]
    left = max((width - height) // 2, 0)
    square = np.ascontiguousarray(color[:, left : left + height])
    return import_cv2().resize(square, (EDGE, EDGE), interpolation=import_cv2().INTER_AREA)


def play_grasp(pressed: PressedGrasp, rng: np.random.Generator) -> Iterator[tuple[TwinState, float]]:
    """Yield states and relaxed grasp forces [N] of an object that is grasped, held and let go, image by image."""
    start, speed = -rng.uniform(*CLEARANCE), rng.choice(SPEEDS)
    end = pressed.find_closing(rng.uniform(*FORCES))
    way = (end - start) / speed
    times = np.cumsum([0.0, OPEN, way, rng.uniform(*HELD), way, OPEN])
    stamps = np.arange(0.0, times[-1], 1.0 / RATE)
    closings = np.interp(stamps, times, [start, start, end, end, start, start])
    wrenches = pressed.relaxation()
    for stamp, closing in zip(stamps, closings, strict=True):
        opening = pressed.touch_opening - 2.0 * float(closing)
        relaxed = [wrenches[side].update(one, 1.0 / RATE) for side, one in pressed.wrenches(opening).items()]
        yield pressed.state(opening, float(stamp)), min(float(np.linalg.norm(one.force)) for one in relaxed)


def write_grasps(scene: str, height: float, count: int, seed: int, path: str) -> dict[str, int]:
    """Write some grasps of an object at a height [m], each with materials, background and motion of its own."""
    pressed = PressedGrasp(build_scenario(scene, height=height), step=STEP)
    camera, images, force, starts = parse_size(SIZE), [], [], [0]
    for number in range(seed, seed + count):
        simulated_camera, before = SimulatedCamera(pressed, camera, number), None
        for state, truth in play_grasp(pressed, np.random.default_rng((number, 21))):
            images.append(shrink_image(simulated_camera.shoot(state, before).color))
            force.append(truth)
            before = state
        starts.append(len(force))
    with Path(path).open("wb") as file:
        np.savez(file, images=np.stack(images), force=np.float32(force), starts=starts)
    return {"images": len(force)}


def load_grasps(folder: Path) -> GraspImages:
    """Read the files of a folder.

    Raises:
        TrainingError: there are none, or one is not of this program.
    """
    parts, shift = [], 0
    for path in tqdm(sorted(folder.glob("grasp_*.npz")), desc="read", unit="file", leave=False):
        try:
            with np.load(path, allow_pickle=False) as content:
                images, force, starts = (content[name] for name in ("images", "force", "starts"))
        except (OSError, ValueError, KeyError) as error:
            raise TrainingError(f"{path}: {error}; expected images, force and starts of grasps") from error
        parts.append((images, force, starts[:-1] + shift))
        shift += len(force)
    if not parts:
        raise TrainingError(f"{folder}: no file grasp_*.npz; make some with python -m lab.training.grasps")
    images, force, starts = (np.concatenate(column) for column in zip(*parts, strict=True))
    return GraspImages(images=images, force=force, starts=np.append(starts, shift))


def main(arguments: Sequence[str] | None = None) -> None:
    """Render a data set; what is there already stays."""
    parser = argparse.ArgumentParser(prog="python -m lab.training.grasps", description=__doc__)
    parser.add_argument("folder", type=Path, help="where the files are written")
    text = "of each object at each height (10), some 70 images each"
    parser.add_argument("--grasps", type=whole_number(1, 10**6), default=10, help=text)
    add_engine_options(parser)
    options = parser.parse_args(arguments)
    tasks = []
    for number, (height, scene) in enumerate(product(HEIGHTS, SCENES)):
        name = f"{scene}_{1e3 * height:.0f}"
        given = {"scene": scene, "height": float(height), "count": options.grasps}
        given |= {"seed": FIRST_SEED + number * options.grasps, "path": str(options.folder / f"{name}.npz")}
        tasks.append(Task(name=name, key=f"{SIZE} {given}", work=write_grasps, given=given, output=given["path"]))
    with one_line_errors():
        lines = make_all(tasks, read_engine(options), options.folder, "file")
    print(f"{sum(line['figures']['images'] for line in lines)} images of {options.grasps * len(lines)} grasps")


if __name__ == "__main__":
    from lab.training.grasps import main as run  # under the name by which the workers of a cluster find its functions

    run()
