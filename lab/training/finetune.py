"""Train the shipped network further on a user's labelled images.

`python -m lab.training.finetune CollectedData_X.csv --camera camera.yaml --jaw FILE --network FOLDER -o FOLDER`
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm import tqdm

from finforce.camera import CameraIntrinsics
from finforce.camera_file import read_camera
from finforce.gripper_frames import SIDES, jaw_in_camera, jaw_in_gripper, read_extrinsics
from finforce_eval.recordings.frames import read_picture
from finforce_ifea.jaw.jaw import Jaw, load_jaw
from finforce_keypoints.geometry.side_picture import find_side, intersect_plane, map_picture, take_picture
from finforce_keypoints.geometry.template import draw_template, find_shape, fit_grid
from finforce_keypoints.networks.metadata import build_name_map, parse_mapping
from finforce_keypoints.networks.side_network import SideNetwork
from lab.training.commands import TrainingError, one_line_errors
from lab.training.evaluate import detect, format_scores, score_detections
from lab.training.pictures import MARGIN, TRAIN, FingerPictures, load_pictures

SCORER, INDIVIDUALS, BODYPARTS, COORDS = HEADERS = ("scorer", "individuals", "bodyparts", "coords")
FOLDER = "labeled-data"  # how the index of a frame begins
_SINGLE = "single"  # DeepLabCut's individual for body parts that are there once
BASE_PART = 0.3  # of the jaw's length: key points nearer to the base hardly move when the jaw bends


@dataclass(frozen=True, kw_only=True, eq=False)
class Labels:
    """Points that somebody marked in n images.

    Attributes:
        images: (n,) paths relative to the DeepLabCut project, with slashes: labeled-data/VIDEO/img0001.png.
        names: (K,) of the body parts; INDIVIDUAL_BODYPART where there are several individuals.
        points: (n, K, 2) column and row [px]; NaN where a point was not marked because it is hidden.
    """

    images: tuple[str, ...]
    names: tuple[str, ...]
    points: NDArray


def read_labels(path: str | Path) -> Labels:
    """Read a label file.

    Args:
        path: a CSV file whose index is one column (labeled-data/VIDEO/IMAGE) or three (labeled-data, VIDEO, IMAGE);
            the row `individuals` of multi-animal projects, backslashes and empty cells are understood.

    Raises:
        TrainingError: the file cannot be read, lacks a header or its rows do not fit it.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
        rows = [[cell.strip() for cell in row] for row in csv.reader(text.splitlines())]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise TrainingError(f"{path}: {error}; expected DeepLabCut's CollectedData_SCORER.csv") from error
    rows = [row for row in rows if any(row)]
    try:
        if len({len(row) for row in rows}) != 1:
            raise TrainingError("rows of different lengths; expected a cell for every column of the header")
        return parse_labels(pd.DataFrame(rows))
    except TrainingError as error:
        raise TrainingError(f"{Path(path).name}: {error}") from error


def parse_labels(cells: pd.DataFrame) -> Labels:
    """Return the labels of a file's cells, texts; see `read_labels`.

    Raises:
        TrainingError: a header row is missing, or the columns are not those of points.
    """
    is_head = cells[0].isin(HEADERS)
    head, frames = cells[is_head].set_index(0), cells[~is_head]
    for needed in (BODYPARTS, COORDS):
        if needed not in head.index:
            raise TrainingError(f"no row '{needed}'; expected the header rows scorer, bodyparts and coords")
    if frames.empty:
        raise TrainingError("no frame after the header; expected a row per image")
    index = 3 if frames.iat[0, 0] == FOLDER else 1
    head = head.iloc[:, index - 1 :]
    names = _name_points(head)
    pairs = list(zip(names, head.loc[COORDS], strict=True))
    if len(set(pairs)) != len(pairs) or {(name, axis) for name in names for axis in "xy"} - set(pairs):
        raise TrainingError("the columns are not one x and one y of every body part")
    try:
        values = frames.iloc[:, index:].replace("", "nan").astype(float)
    except ValueError as error:
        raise TrainingError(f"{error}; expected numbers of pixels, or nothing") from error
    values.columns = pd.MultiIndex.from_tuples(pairs)
    kinds = list(dict.fromkeys(names))
    points = np.stack([values[name][["x", "y"]].to_numpy() for name in kinds], axis=1)
    points[~np.isfinite(points).all(axis=2)] = np.nan
    images = pd.Series(["/".join(row).replace("\\", "/") for row in frames.iloc[:, :index].to_numpy()])
    if images.duplicated().any():
        image = images[images.duplicated()].iloc[0]
        raise TrainingError(f"{image} stands in {(images == image).sum()} rows; expected one row per image")
    return Labels(images=tuple(images), names=tuple(kinds), points=points)


def _name_points(head: pd.DataFrame) -> list[str]:
    """Return the names of the columns' points: INDIVIDUAL_BODYPART where there are several individuals."""
    parts = head.loc[BODYPARTS].tolist()
    people = head.loc[INDIVIDUALS].tolist() if INDIVIDUALS in head.index else [_SINGLE] * len(parts)
    several = len(set(people) - {_SINGLE}) > 1
    return [
        f"{person}_{part}" if several and person != _SINGLE else part
        for person, part in zip(people, parts, strict=True)
    ]


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraView:
    """A camera and its place: intrinsics and T_gripper_camera (4, 4)."""

    camera: CameraIntrinsics
    T_gripper_camera: NDArray


def find_origin(points: NDArray, jaw: Jaw, side: str, view: CameraView) -> float | None:
    """Return where a jaw's origin is on the closing axis [m], from its labels.

    The reference point tells it; where it is hidden, the mean of the key points near the base does.

    Args:
        points: (K + 1, 2) labels [px], the reference point last.
        jaw: in its own frame, right jaws mirrored.
        side: "left" or "right".
        view: camera and its place.

    Returns:
        The place, None when neither the reference point nor one near the base is labelled.
    """
    rest = np.vstack((jaw.keypoints, jaw.reference_point))
    chosen = np.isfinite(points).all(axis=1)
    if chosen[-1]:
        chosen = np.arange(len(points)) == len(points) - 1
    else:
        chosen &= rest[:, 2] < BASE_PART * jaw.keypoints[:, 2].max()
    if not chosen.any():
        return None
    at_zero = jaw_in_camera(view.T_gripper_camera, side, 0.0)
    places = intersect_plane(points[chosen], find_side(jaw), at_zero, view.camera)
    along = float((places[:, 0] - rest[chosen, 0]).mean())
    return along * float(jaw_in_gripper(side, 0.0)[0, 0])


def rectify(image: NDArray, points: NDArray, jaw: Jaw, side: str, view: CameraView) -> FingerPictures | None:
    """Return the picture of one jaw's side plane with its points, as training takes it; None if the jaw is not found.

    Args:
        image: (h, w, 3) uint8 RGB.
        points: (K, 2) [px] of one jaw, the reference point last; NaN if hidden.
        jaw: in its own frame, right jaws mirrored.
        side: "left" or "right".
        view: camera and its place.

    Raises:
        TrainingError: the image has another size than the camera.
    """
    height, width = image.shape[:2]
    if (width, height) != (view.camera.width, view.camera.height):
        raise TrainingError(
            f"an image of {width}x{height}; expected {view.camera.width}x{view.camera.height}, the camera's"
        )
    origin = find_origin(points, jaw, side, view)
    if origin is None:
        return None
    return cut_picture(image, points, jaw, jaw_in_camera(view.T_gripper_camera, side, origin), view.camera)


def cut_picture(
    image: NDArray, points: NDArray, jaw: Jaw, T_camera_jaw: NDArray, camera: CameraIntrinsics
) -> FingerPictures:
    """Return the picture of the side plane of a jaw at T_camera_jaw (4, 4) with its labelled points, the mark first."""
    shape, side = find_shape(jaw), find_side(jaw)
    grid = fit_grid(shape)
    padded = grid.padded(MARGIN)
    rest = np.vstack((jaw.reference_point, jaw.keypoints))[:, [0, 2]]
    points = np.roll(points, 1, axis=0)
    visible = np.isfinite(points).all(axis=1)
    place = np.full((len(visible), 2), np.nan, dtype=np.float32)
    place[visible] = padded.pixels(intersect_plane(points[visible], side, T_camera_jaw, camera))
    return FingerPictures(
        picture=take_picture(image, map_picture(padded, side, T_camera_jaw, camera))[None],
        rest=grid.pixels(rest).astype(np.float32)[None],
        place=place[None],
        visible=visible[None],
        keypoints=np.array([len(rest)]),
        template=draw_template(shape, grid)[None],
        finger=np.zeros(1, dtype=int),
    )


FEWEST = 3  # labelled pictures
HELD_BACK = 6  # every sixth picture judges, the others teach; of fewer than twelve every second one
MINUTES = 5.0  # [min] of training
RATE = 3e-4  # largest learning rate
MIXED = 2000  # pictures of the data set that are mixed in


def main(arguments: Sequence[str] | None = None) -> None:
    """Fine-tune a network, print its scores on pictures held back, before and after, and export it."""
    options = build_parser().parse_args(arguments)
    with one_line_errors():
        run(options)


def build_parser() -> argparse.ArgumentParser:
    """Return the options of the command."""
    parser = argparse.ArgumentParser(prog="python -m lab.training.finetune", description=__doc__)
    parser.add_argument("labels", type=Path, help="CollectedData_SCORER.csv")
    parser.add_argument("--project", type=Path, help="folder that holds labeled-data (two above the label file)")
    parser.add_argument("--camera", type=Path, required=True, help="intrinsics: file of ROS, OpenCV, kalibr, ...")
    parser.add_argument("--extrinsics", default="robot", help="the camera in the gripper: x,y,z,qx,qy,qz,qw (robot)")
    parser.add_argument("--network", type=Path, required=True, help="folder of the exported network to begin with")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the fine-tuned network")
    parser.add_argument("--jaw", default="bench", help="jaw file, or name of an included jaw")
    parser.add_argument("--sides", nargs="+", choices=SIDES, default=SIDES, help="labelled jaws (both)")
    parser.add_argument("--map", nargs="*", default=[], help="BODYPART=NAME for body parts with names of their own")
    parser.add_argument("--dataset", type=Path, help="shards of training.scenes, mixed in against forgetting")
    parser.add_argument("--minutes", type=float, default=MINUTES, help=f"time for training ({MINUTES:g})")
    parser.add_argument("--rate", type=float, default=RATE, help=f"largest learning rate ({RATE:g})")
    parser.add_argument("--threads", type=int, default=1, help="threads of the network's arithmetic (1)")
    parser.add_argument("--seed", type=int, default=0, help="of order and augmentation (0)")
    return parser


def run(options: argparse.Namespace) -> None:
    """Fine-tune as the options say."""
    # PyTorch is only wanted once the labels are known to be usable
    folder = options.project or options.labels.resolve().parent.parent.parent
    labels, T_gripper_camera = read_labels(options.labels), read_extrinsics(options.extrinsics)
    view = CameraView(camera=read_camera(options.camera), T_gripper_camera=T_gripper_camera)
    pictures = load_project(labels, folder, view, options.jaw, options.sides, parse_mapping(options.map))
    from lab.training.train import refine

    every = HELD_BACK if len(pictures) >= 2 * HELD_BACK else 2
    judging = np.arange(len(pictures)) % every == every - 1
    teaching, judges = pictures.take(~judging), pictures.take(judging)
    mixed = load_pictures(options.dataset, TRAIN, MIXED) if options.dataset else None
    before = detect(SideNetwork(options.network, threads=1), judges)
    refine(options, teaching, judges, mixed)
    after = detect(SideNetwork(options.output, threads=1), judges)
    print(format_scores({"before": score_detections(before), "after": score_detections(after)}))


def load_project(
    labels: Labels, folder: Path, view: CameraView, jaw: str, sides: Sequence[str], mapping: Mapping[str, str]
) -> FingerPictures:
    """Return every labelled jaw of a DeepLabCut project as a rectified picture, with a progress bar.

    Args:
        labels: of its images.
        folder: that holds them.
        view: of their camera.
        jaw: jaw file, or name of an included jaw.
        sides: labelled jaws.
        mapping: names of the jaw's points by body part, where they differ.

    Raises:
        RecordingError: an image is missing or damaged.
        TrainingError: an image is of another size, or hardly any picture shows a labelled jaw.
        NamingError: the body parts are not the jaws' key points.
    """
    left = load_jaw(jaw)
    jaws = {side: left if side == "left" else left.mirrored() for side in sides}
    rows = build_name_map(labels.names, jaws, mapping).rows
    found = []
    for number, name in enumerate(tqdm(labels.images, desc="images", leave=False)):
        image = read_picture(folder / name)
        for side, own in jaws.items():
            found.append(rectify(image, labels.points[number, rows[side]], own, side, view))
    usable = [picture for picture in found if picture is not None]
    if len(usable) < FEWEST:
        raise TrainingError(
            f"{len(usable)} of {len(found)} pictures show a jaw with its reference point or a key point near its base; "
            f"expected at least {FEWEST}, better 50 to 300"
        )
    return FingerPictures.join(usable)


if __name__ == "__main__":
    main()
