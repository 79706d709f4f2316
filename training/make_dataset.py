"""Pictures for training, rendered by the twin: `python -m training.make_dataset FOLDER`.

Every scene has its own materials, lights, background, object, camera place and deformed jaws. What is written are the
rectified pictures of the jaws' side planes, with a margin for shifting and turning them later.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from finforce.camera import CameraIntrinsics
from finforce.gripper_frames import BENCH_CAMERA, ROBOT_CAMERA
from finforce_contact.mesh.triangles import ObjectMesh
from finforce_ifea.jaw.jaw import Jaw, load_jaw
from finforce_keypoints.geometry.side_picture import PlaneGrid, find_side, intersect_plane, map_picture, take_picture
from finforce_twin.gripper.gripper import JawState, TwinState
from finforce_twin.rendering.bodies import DrawnJaw, draw_jaws
from finforce_twin.rendering.depth_camera import build_d405, build_d405_vga
from finforce_twin.rendering.photographer import Photographer, SceneSetting, Shot
from finforce_twin.scenes.objects import OBJECT_NAMES, build_object
from training.arguments import one_line_errors
from training.dataset import MARGIN, TRAIN, VALIDATION, LabelledPictures, join_pictures, save_shard
from training.pressed_shapes import PressedShape, draw_pressed_shapes

SEEDS = 1_000_000_000  # of training's pictures begin here, so that no scene with a seed below was trained on
SHARD = 256  # pictures a file
OBJECTS = 240  # pressed into the jaw
SEGMENTS = 64
EMPTY = 0.12  # share of the scenes without any object
APART = 0.2  # share of the scenes whose object does not touch
SKEWED = 0.12  # share of the scenes with an object of another kind, anyhow between the jaws
ONE_JAW = 0.25  # share of the scenes with one jaw, before the bench's camera
DIM = 0.3  # share of the scenes in dim light


class SceneMaker:
    """Draws scenes by chance.

    Args:
        jaw: the left jaw.
        shapes: under objects, of that jaw.
    """

    def __init__(self, jaw: Jaw, shapes: list[PressedShape]) -> None:
        self._jaws = {"left": jaw, "right": jaw.mirrored()}
        self._drawn: dict[str, DrawnJaw] = draw_jaws(self._jaws, "default")
        self._pressed = shapes
        self._others = [build_object(name) for name in OBJECT_NAMES]
        self._grid = PlaneGrid().padded(MARGIN)

    def draw(self, seed: int) -> LabelledPictures:
        """Return the pictures of one scene, one per jaw."""
        rng = np.random.default_rng((seed, 5))
        one_jaw = rng.random() < ONE_JAW
        camera = build_d405_vga() if rng.random() < 0.7 else build_d405(distorted=True)
        T = _disturb(BENCH_CAMERA if one_jaw else ROBOT_CAMERA, rng)
        mesh, state = self._draw_state(rng, ("left",) if one_jaw else ("left", "right"))
        setting = SceneSetting(
            shapes=self._drawn,
            mesh=mesh,
            camera=camera,
            T_gripper_camera=T,
            light="dim" if rng.random() < DIM else "any",
            clutter=True,
        )
        shot = Photographer(setting, SEEDS + seed, window_only=True).shoot(state)
        return join_pictures([self._cut(side, shot, camera) for side in shot.truth])

    def _draw_state(self, rng: np.random.Generator, sides: tuple[str, ...]) -> tuple[ObjectMesh | None, TwinState]:
        """Return an object, or none, and the jaws around it."""
        shape = self._pressed[rng.integers(len(self._pressed))]
        chance = rng.random()
        pressed = chance > EMPTY + APART
        gap = 0.0 if pressed else rng.uniform(0.5e-3, 25e-3)
        origin = -0.055 if len(sides) == 1 else -(shape.centre[0] + gap)
        jaws = {}
        for side in sides:
            drawn = self._pressed[rng.integers(len(self._pressed))] if rng.random() < 0.1 else shape
            jaws[side] = self._jaw_state(side, origin if side == "left" else -origin, drawn if pressed else None)
        T = np.eye(4)
        T[:3, 3] = (origin + shape.centre[0] + gap, rng.uniform(-0.012, 0.012), shape.centre[1])
        mesh = None if chance < EMPTY else _build_rod(shape, rng)
        if mesh is not None and rng.random() < SKEWED:
            mesh, T[:3, :3] = self._others[rng.integers(len(self._others))], Rotation.random(rng=rng).as_matrix()
            mesh = replace(mesh, vertices=mesh.vertices * rng.uniform(0.25, 0.7))
        state = TwinState(stamp=0.0, phase="", jaws=jaws, T_gripper_object=T, gravity=np.array([0.0, 0.0, 1.0]))
        return mesh, state

    def _jaw_state(self, side: str, origin_x: float, shape: PressedShape | None) -> JawState:
        jaw = self._jaws["left"]
        vertices = self._drawn["left"].rest if shape is None else shape.vertices
        keypoints = jaw.keypoints if shape is None else shape.keypoints
        mirror = np.array([1.0, 1.0 if side == "left" else -1.0, 1.0])
        # the mirrored mesh has its own order of vertices where elements were turned round
        return JawState(
            origin_x=origin_x,
            vertices=vertices * mirror,
            keypoints=keypoints * mirror,
            reference=jaw.reference_point * mirror,
            force=np.zeros(3),
            torque=np.zeros(3),
        )

    def _cut(self, side: str, shot: Shot, camera: CameraIntrinsics) -> LabelledPictures:
        """Return the picture of one jaw."""
        truth, side_y = shot.truth[side], find_side(self._jaws[side])
        picture = take_picture(shot.color, map_picture(self._grid, side_y, truth.T_camera_jaw, camera))
        places = intersect_plane(truth.pixels, side_y, truth.T_camera_jaw, camera)
        xz = self._grid.pixels(places).astype(np.float32)
        return LabelledPictures(picture=picture[None], xz=xz[None], visible=truth.visible[None])


def _disturb(T_gripper_camera: NDArray, rng: np.random.Generator) -> NDArray:
    """Return a camera place a few centimetres and degrees away, still looking at the jaws."""
    T, change = T_gripper_camera.copy(), np.eye(4)
    T[:3, 3] += rng.uniform((-0.01, -0.015, -0.02), (0.01, 0.035, 0.02))
    change[:3, :3] = Rotation.from_rotvec(rng.normal(0.0, 0.04, 3)).as_matrix()
    return T @ change


def _build_rod(shape: PressedShape, rng: np.random.Generator) -> ObjectMesh:
    """Return the pressed object as a mesh about its centre, its axis along y."""
    half = rng.uniform(0.006, 0.035)
    if shape.is_round:
        angles = np.linspace(0.0, 2.0 * np.pi, SEGMENTS, endpoint=False)
        outline = 0.5 * shape.size * np.column_stack((np.cos(angles), np.sin(angles)))
    else:
        outline = 0.5 * shape.size * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    count = len(outline)
    ends = [np.column_stack((outline[:, 0], np.full(count, y), outline[:, 1])) for y in (-half, half)]
    index = np.arange(count)
    following = (index + 1) % count
    sides = np.vstack(
        (
            np.column_stack((index, index + count, following)),
            np.column_stack((following, index + count, following + count)),
        )
    )
    lids = np.column_stack((np.zeros(count - 2, dtype=int), index[1:-1], index[2:]))
    return ObjectMesh(
        vertices=np.vstack(ends),
        triangles=np.vstack((sides, lids, lids[:, ::-1] + count)),
        watertight=True,
        name="rod",
    )


def make_shards(maker: SceneMaker, seeds: range, folder: Path, name: str) -> None:
    """Render scenes and write their pictures as `NAME_NNNN.npz`."""
    for number, pictures in enumerate(_gather(maker, seeds, name)):
        save_shard(folder / f"{name}_{number:04d}.npz", pictures)


def _gather(maker: SceneMaker, seeds: range, name: str) -> Iterator[LabelledPictures]:
    """Yield the pictures of many scenes in portions."""
    waiting: list[LabelledPictures] = []
    for seed in tqdm(seeds, desc=name, disable=None, smoothing=0.0):
        waiting.append(maker.draw(seed))
        if sum(map(len, waiting)) >= SHARD or seed == seeds[-1]:
            yield join_pictures(waiting)
            waiting = []


def main() -> None:
    """Render a data set."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="where the files are written")
    parser.add_argument("--jaw", default="bench", help="jaw file, or the name of a shipped jaw")
    parser.add_argument("--scenes", type=int, default=3000, help="for training (3000)")
    parser.add_argument("--validation", type=int, default=250, help="scenes for validation (250)")
    parser.add_argument("--first", type=int, default=0, help="seed of the first scene, to share the work (0)")
    options = parser.parse_args()
    with one_line_errors():
        run(options)


def run(options: argparse.Namespace) -> None:
    """Render what the options say."""
    options.folder.mkdir(parents=True, exist_ok=True)
    jaw = load_jaw(options.jaw)
    # validation has its own objects, not only its own materials and lights
    for name, first, count, seed in (
        (VALIDATION, 10_000_000 + options.first, options.validation, 2),
        (TRAIN, options.first, options.scenes, 1),
    ):
        if count:
            maker = SceneMaker(jaw, draw_pressed_shapes(jaw, OBJECTS if name == TRAIN else OBJECTS // 6, seed))
            make_shards(maker, range(first, first + count), options.folder, f"{name}_{options.first}")


if __name__ == "__main__":
    main()
