"""Photographs of the measured steel finger to key points: `python -m tools.photographs FOLDER --measurement FILE`.

The camera comes from the optical table's holes, the finger's place from the two feet of its strips in the first
photograph (two clicks), the key points from the shipped network with the steel finger's jaw file. Labelled
photographs, named by their displacements, refine place and network; the others judge both. What is found is written
in the form of the measurement, for `finforce convert-steel --source` and `finforce evaluate --jaw steel`.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from finforce.camera import CameraIntrinsics, project
from finforce.optional import import_cv2
from finforce_eval.cli.convert_steel import HALF_BASE, points_from_picture
from finforce_ifea.jaw.jaw import Jaw, load_jaw
from finforce_keypoints.build import ANY_FINGER
from finforce_keypoints.detectors.side_plane import AnyFinger
from finforce_keypoints.geometry.extrinsics import GridCamera, find_grid_camera
from finforce_keypoints.geometry.side_picture import find_side, map_picture, project_plane, take_picture
from finforce_keypoints.networks.side_network import SideNetwork

PITCH = 0.025  # [m] between the table's holes
HEIGHT = 0.04  # [m] of the finger's middle above the table, to begin with
FEET = (1057.0, 836.0, 1354.0, 834.0)  # px of the feet of strips A and B in the photograph of 5 mm
FEET_AT_REST = np.array([[HALF_BASE, 0.0, 0.0], [-HALF_BASE, 0.0, 0.0]]) * 1e-3  # [m] in the jaw frame
SQUARE = np.column_stack(
    ([-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0])
)  # jaw axes in the table's: tip up, y at us


@dataclass(frozen=True, kw_only=True, eq=False)
class Photograph:
    """A photograph, its camera, by how much the base was moved [mm], and the hand-picked hinges (8, 3) [m] or None."""

    name: str
    image: NDArray
    grid: GridCamera
    displacement: float
    truth: NDArray | None

    @property
    def camera(self) -> CameraIntrinsics:
        """The intrinsics."""
        return self.grid.camera


@dataclass(frozen=True, kw_only=True)
class FingerPlace:
    """Where the finger is on the table when its base is not moved: x, y and height [m], turn [rad], and its way.

    The base moves along the table's rows by `sign` times its displacement.
    """

    x: float
    y: float
    height: float
    turn: float
    sign: float = -1.0

    def pose(self, photograph: Photograph) -> NDArray:
        """Return T_camera_jaw (4, 4)."""
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec([0.0, 0.0, self.turn]).as_matrix() @ SQUARE
        T[:3, 3] = self.x + 1e-3 * self.sign * photograph.displacement, self.y, -self.height
        return photograph.grid.T_camera_table @ T


def main(arguments: Sequence[str] | None = None) -> None:
    """Find the hinges in photographs, compare them with the hand-picked ones, and write them."""
    parser = argparse.ArgumentParser(prog="python -m tools.photographs", description=__doc__)
    parser.add_argument("folder", type=Path, help="of photographs ..._NNmm.jpg")
    parser.add_argument("--measurement", type=Path, required=True, help="JSON with displacement_mm, nodes and force")
    parser.add_argument("--network", type=Path, default=ANY_FINGER, help="folder of the network (the shipped one)")
    parser.add_argument(
        "--feet", type=float, nargs=4, default=FEET, metavar="PX", help="feet of both strips at the least displacement"
    )
    parser.add_argument(
        "--labels", type=float, nargs="*", default=(), metavar="MM", help="displacements whose hinges may be used"
    )
    parser.add_argument("--minutes", type=float, default=6.0, help="of fine-tuning on the labels (6); 0: none")
    parser.add_argument("--dataset", type=Path, help="shards of lab.training.scenes, mixed in against forgetting")
    parser.add_argument("-o", "--output", type=Path, default=Path("photographs"), help="folder of pictures and results")
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    measurement = json.loads(options.measurement.read_text(encoding="utf-8"))
    photographs = read_photographs(options.folder, measurement)
    jaw = with_feet(load_jaw("steel"))
    place = place_by_feet(photographs[0], np.reshape(options.feet, (2, 2)))
    labelled = [one for one in photographs if one.displacement in options.labels]
    found = find_hinges(photographs, jaw, place, options.network)
    if labelled:
        place = place_by_labels(labelled, [found[one.name] for one in labelled], place)
        found = find_hinges(photographs, jaw, place, options.network)
    report("as shipped", photographs, found, labelled)
    if labelled and options.minutes > 0.0:
        network = refine_network(options, jaw, labelled, place)
        found = find_hinges(photographs, jaw, place, network)
        report("fine-tuned", photographs, found, labelled)
        found = find_hinges(photographs, jaw, place, network, by_feet=True)
        report("fine-tuned, from the feet in each photograph", photographs, found, labelled)
    draw(options.output / "photographs.png", photographs, found, jaw, place)
    nodes = [to_nodes(found[one.name]) for one in photographs]
    levels = [one.displacement for one in photographs]
    rows = [measurement["displacement_mm"].index(level) for level in levels]
    content = {
        **measurement,
        "displacement_mm": levels,
        "nodes": nodes,
        "force": [measurement["force"][k] for k in rows],
    }
    (options.output / "found.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
    print(f"{options.output / 'found.json'}: finforce convert-steel BAG --source it; finforce evaluate BAG --jaw steel")


def with_feet(jaw: Jaw) -> Jaw:
    """Return the steel finger with the feet of its strips as two more key points: there the picked frame begins."""
    names = (*jaw.keypoint_names, "foot_a", "foot_b")
    return replace(jaw, keypoint_names=names, keypoints=np.vstack((jaw.keypoints, FEET_AT_REST)))


def read_photographs(folder: Path, measurement: dict) -> list[Photograph]:
    """Return the photographs of a folder by displacement, each with its camera."""
    cv2, found = import_cv2(), []
    for path in sorted(folder.glob("*.jpg")):
        match = re.search(r"_(\d+(?:\.\d+)?)mm$", path.stem)
        if not match:
            continue
        image = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
        level = float(match[1])
        known = level in measurement["displacement_mm"]
        nodes = measurement["nodes"][measurement["displacement_mm"].index(level)] if known else None
        truth = None if nodes is None else points_from_picture(nodes)
        grid = find_grid_camera(image, PITCH)
        found.append(Photograph(name=path.stem, image=image, grid=grid, displacement=level, truth=truth))
    if not found:
        raise SystemExit(f"{folder}: no photographs ..._NNmm.jpg")
    return sorted(found, key=lambda one: one.displacement)


def place_by_feet(photograph: Photograph, feet: NDArray) -> FingerPlace:
    """Return the place that shows the feet of both strips at pixels (2, 2), A and then B."""

    def misses(x: NDArray) -> NDArray:
        T = build_place(x).pose(photograph)
        return (project(FEET_AT_REST @ T[:3, :3].T + T[:3, 3], photograph.camera) - feet).ravel()

    return build_place(least_squares(misses, [0.0, 0.05, HEIGHT, 0.0], x_scale=[0.01, 0.01, 0.01, 0.05]).x)


def place_by_labels(photographs: list[Photograph], found: list[Finding], place: FingerPlace) -> FingerPlace:
    """Return the place at which the hand-picked hinges lie where the network sees them, far ones counting less."""

    def misses(x: NDArray) -> NDArray:
        here, away = build_place(x), []
        for one, seen in zip(photographs, found, strict=True):
            T = here.pose(one)
            places = project(one.truth @ T[:3, :3].T + T[:3, 3], one.camera)
            away.append((places - seen.pixels) / seen.stddev[:, None])
        return np.concatenate(away).ravel()

    start = [place.x, place.y, place.height, place.turn]
    fit = least_squares(misses, start, x_scale=[0.01, 0.01, 0.01, 0.05], loss="soft_l1", f_scale=1.0)
    return build_place(fit.x)


def build_place(x: NDArray) -> FingerPlace:
    """Return a place of its numbers."""
    return FingerPlace(x=float(x[0]), y=float(x[1]), height=float(x[2]), turn=float(x[3]))


@dataclass(frozen=True, kw_only=True, eq=False)
class Finding:
    """Hinges in one photograph: points (8, 3) [m, jaw frame], pixels (8, 2), their deviations (8,) [px]."""

    points: NDArray
    pixels: NDArray
    stddev: NDArray


def find_hinges(
    photographs: list[Photograph], jaw: Jaw, place: FingerPlace, network: Path, *, by_feet: bool = False
) -> dict[str, Finding]:
    """Return what the network finds, by photograph; `by_feet` beside the feet that it sees, not beside the place's."""
    locator, found = AnyFinger(SideNetwork(network, threads=1), {"left": jaw}), {}
    grid, side = locator.grids["left"], find_side(jaw)
    for one in photographs:
        T = place.pose(one)
        picture = take_picture(one.image, map_picture(grid, side, T, one.camera))
        seen = locator.locate(picture[None], ["left"])
        places = grid.places(seen.pixels[0, :-1])
        hinges, feet = places[: -len(FEET_AT_REST)], places[-len(FEET_AT_REST) :]
        weight = seen.stddev[0, [-3, -2]] ** -2.0
        shift = weight @ (feet - FEET_AT_REST[:, [0, 2]]) / weight.sum() if by_feet else np.zeros(2)
        found[one.name] = Finding(
            points=np.insert(hinges - shift, 1, 0.0, axis=1),
            pixels=project_plane(hinges, side, T, one.camera),
            stddev=seen.stddev[0, : len(hinges)],
        )
    return found


def refine_network(options: argparse.Namespace, jaw: Jaw, labelled: list[Photograph], place: FingerPlace) -> Path:
    """Train the network further on labelled photographs and return its folder."""
    from lab.training.labels import LabelledImage, cut_picture
    from lab.training.pictures import TRAIN, FingerPictures, load_pictures
    from lab.training.train import refine

    pictures = []
    for one in labelled:
        T = place.pose(one)
        points = project(np.vstack((one.truth, FEET_AT_REST)) @ T[:3, :3].T + T[:3, 3], one.camera)
        marked = LabelledImage(image=one.image, points=np.vstack((points, np.full((1, 2), np.nan))))
        pictures.append(cut_picture(marked, jaw, T, one.camera))
    teaching = FingerPictures.join(pictures)
    mixed = load_pictures(options.dataset, TRAIN, 1000) if options.dataset else None
    settings = argparse.Namespace(
        network=options.network,
        output=options.output / "network",
        minutes=options.minutes,
        rate=3e-4,
        threads=1,
        seed=0,
    )
    refine(settings, teaching, teaching, mixed)
    return settings.output


def report(words: str, photographs: list[Photograph], found: dict[str, Finding], labelled: list[Photograph]) -> None:
    """Print how far the hinges lie from the hand-picked ones."""
    print(f"{words}: distance from the hand-picked hinges [mm], base to tip, strip A and then B")
    rows = []
    for one in photographs:
        if one.truth is None:
            continue
        away = 1e3 * np.linalg.norm(found[one.name].points - one.truth, axis=1)
        is_label = one in labelled
        rows.append((is_label, away))
        print(
            f"  {one.displacement:4.0f} mm {'label' if is_label else '':5} {np.round(away, 1)} mean {away.mean():.2f}"
        )
    for is_label, name in ((False, "judged"), (True, "labels")):
        mine = [away for which, away in rows if which == is_label]
        if mine:
            away = np.concatenate(mine)
            print(
                f"  {name}: mean {away.mean():.2f}, root mean square {np.sqrt((away**2).mean()):.2f}, "
                f"largest {away.max():.1f} mm"
            )


def draw(path: Path, photographs: list[Photograph], found: dict[str, Finding], jaw: Jaw, place: FingerPlace) -> None:
    """Write the rectified photographs, hand-picked hinges green and found ones red."""
    cv2, tiles = import_cv2(), []
    grid = AnyFinger(SideNetwork(ANY_FINGER, threads=1), {"left": jaw}).grids["left"]
    for one in photographs:
        T = place.pose(one)
        tile = cv2.resize(take_picture(one.image, map_picture(grid, find_side(jaw), T, one.camera)), None, fx=2, fy=2)
        for points, color in ((one.truth, (40, 220, 60)), (found[one.name].points, (255, 40, 40))):
            for x, y in grid.pixels(points[:, [0, 2]]) if points is not None else ():
                cv2.circle(tile, (round(2 * x + 0.5), round(2 * y + 0.5)), 5, color, 1, cv2.LINE_AA)
        tiles.append(tile)
    cv2.imwrite(str(path), np.hstack(tiles)[..., ::-1])


def to_nodes(finding: Finding) -> list[list[float]]:
    """Return hinges as the measurement has them: x from strip A to strip B, y from the base on [mm]."""
    points = 1e3 * finding.points
    return np.column_stack((HALF_BASE - points[:, 0], points[:, 2])).round(3).tolist()


if __name__ == "__main__":
    main()
