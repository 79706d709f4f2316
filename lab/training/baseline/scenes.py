"""Grasps for the end-to-end network: small colour images and the true grasp force.

`python -m lab.training.baseline.scenes DATA` renders grasps of a cylinder and a cube, as the paper's network has seen.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finforce.errors import FinforceError
from finforce_eval.cli.parser import add_engine_options, read_engine, whole_number
from finforce_eval.tasks import EngineOptions, Task, choose_shard
from finforce_sim.footage import FINGER, parse_size, set_stage
from finforce_sim.gripper import TwinGripper
from finforce_sim.photographer import Photographer
from finforce_sim.scenarios import Scenario, build_scenario
from lab.experiments.network import reduce_image
from lab.training.commands import DatasetError, one_line_errors
from lab.training.pictures import TRAIN, VALIDATION, make_all, save_arrays

OBJECTS = ("grasp_cylinder", "grasp_cube")
PLACES = np.linspace(0.028, 0.054, 14)  # [m] of the object's middle, as many as the paper's
SPEEDS = (0.002, 0.004, 0.008, 0.015, 0.03)  # [m/s] of each jaw, as many as the paper's
DISPLACEMENT = (0.0015, 0.0075)  # [m] of each jaw beyond first touch
RENDERED = "320x240"
OPEN = 12  # images before the jaws move


@dataclass(frozen=True, kw_only=True, eq=False)
class GraspFilm:
    """The images of one grasp and what they should tell.

    Attributes:
        images: (n, h, w, 3) uint8 RGB, 30 a second.
        force: (n,) min(|F_left|, |F_right|) [N].
    """

    images: NDArray
    force: NDArray


def draw_scenario(rng: np.random.Generator) -> Scenario:
    """Return a grasp by chance."""
    return build_scenario(
        str(rng.choice(OBJECTS)),
        height=float(rng.choice(PLACES)),
        closing_speed=float(rng.choice(SPEEDS)),
        displacement=float(rng.uniform(*DISPLACEMENT)),
        clearance=float(rng.uniform(5e-4, 3e-3)),
        settle=0.2,
        record=0.2,
    )


def film_grasp(seed: int) -> GraspFilm:
    """Return the images of a grasp by chance, from shortly before the jaws move.

    Raises:
        FinforceError: the jaws cannot be pressed so far.
    """
    scenario = draw_scenario(np.random.default_rng((seed, 21)))
    gripper = TwinGripper(scenario, FINGER)
    photographer = Photographer(set_stage(gripper, parse_size(RENDERED), 1e-3), seed)
    states = list(gripper.states())
    moving = next(number for number, state in enumerate(states) if state.phase == "0:load:0:ramp")
    kept = states[max(moving - OPEN, 0) :]
    forces = [min(float(np.linalg.norm(jaw.force)) for jaw in state.jaws.values()) for state in kept]
    images = [reduce_image(photographer.shoot(state).color) for state in kept]
    return GraspFilm(images=np.stack(images), force=np.array(forces, dtype=np.float32))


def load_films(folder: Path, name: str) -> list[GraspFilm]:
    """Return the grasps of a data set whose files begin with a name.

    Raises:
        DatasetError: there are none, or a file is none of this program's.
    """
    films = []
    for path in sorted(folder.glob(f"{name}_*.npz")):
        try:
            with np.load(path, allow_pickle=False) as content:
                films.append(GraspFilm(images=content["images"], force=content["force"]))
        except (OSError, ValueError, KeyError) as error:
            raise DatasetError(f"{path}: {error}; expected images and force of a grasp") from error
    if not films:
        raise DatasetError(f"{folder}: got no file {name}_*.npz, expected those of lab.training.baseline.scenes")
    return films


def write_film(seed: int, path: str) -> dict[str, int]:
    """Write the file of a seed and return how many images are in it; none where the jaws cannot be pressed so far."""
    try:
        film = film_grasp(seed)
    except FinforceError:  # another seed will do
        return {"images": 0}
    save_arrays(Path(path), {"images": film.images, "force": film.force})
    return {"images": len(film.force)}


def write_films(seeds: Sequence[int], folder: Path, name: str, engine: EngineOptions, shard: str = "") -> int:
    """Write a file for each seed that is not done yet, and return how many images are in them all.

    Raises:
        DatasetError: one could not be made or written.
    """
    tasks = []
    for seed in choose_shard(seeds, shard):
        path = str(folder / f"{name}_{seed:09d}.npz")
        tasks.append(Task(name=Path(path).stem, key=RENDERED, work=write_film, given={"seed": seed, "path": path}))
    return sum(line["figures"]["images"] for line in make_all(tasks, engine, folder, shard, "grasp"))


def main(arguments: Sequence[str] | None = None) -> None:
    """Render a data set; what is there already stays."""
    parser = argparse.ArgumentParser(prog="python -m lab.training.baseline.scenes", description=__doc__)
    parser.add_argument("folder", type=Path, help="where the files are written")
    parser.add_argument(
        "--grasps", type=whole_number(0, 10**9), default=400, help="for training (400), some 150 images each"
    )
    parser.add_argument("--validation", type=whole_number(0, 10**9), default=24, help="grasps for validation (24)")
    parser.add_argument(
        "--first", type=whole_number(0, 10**9), default=0, help="seed of the first grasp, to share the work (0)"
    )
    add_engine_options(parser)
    options = parser.parse_args(arguments)
    with one_line_errors():
        engine = read_engine(options)
        for name, first, count in ((VALIDATION, 10_000_000, options.validation), (TRAIN, 0, options.grasps)):
            seeds = range(first + options.first, first + options.first + count)
            print(f"{name}: {write_films(seeds, options.folder, name, engine, options.shard)} images")


if __name__ == "__main__":
    main()
