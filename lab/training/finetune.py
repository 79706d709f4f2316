"""Train the shipped network further on a user's labelled images.

`python -m lab.training.finetune CollectedData_X.csv --camera camera.yaml --jaw FILE --network FOLDER -o FOLDER`
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from finforce.gripper_frames import SIDES
from finforce.optional import import_cv2
from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints.networks.metadata import build_name_map, parse_mapping
from finforce_keypoints.networks.side_network import SideNetwork
from lab.training.commands import LabelFileError, one_line_errors
from lab.training.evaluate import detect, format_scores, score_detections
from lab.training.labels import CameraView, LabelledImage, Labels, read_camera, read_labels, rectify
from lab.training.pictures import TRAIN, FingerPictures, load_pictures

FEWEST = 3  # labelled pictures
HELD_BACK = 6  # every sixth picture judges, the others teach; of fewer than twelve every second one
MINUTES, RATE = 5.0, 3e-4
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
    parser.add_argument("--camera", type=Path, required=True, help="YAML of intrinsics and T_gripper_camera")
    parser.add_argument("--network", type=Path, required=True, help="folder of the exported network to begin with")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the fine-tuned network")
    parser.add_argument("--jaw", default="bench", help="jaw file, or the name of a shipped jaw")
    parser.add_argument("--sides", nargs="+", choices=SIDES, default=SIDES, help="labelled jaws (both)")
    parser.add_argument("--map", nargs="*", default=[], help="BODYPART=NAME for body parts with names of their own")
    parser.add_argument("--dataset", type=Path, help="shards of training.scenes, mixed in against forgetting")
    add_refinement(parser)
    return parser


def add_refinement(parser: argparse.ArgumentParser) -> None:
    """Add how long and how fast the network learns."""
    parser.add_argument("--minutes", type=float, default=MINUTES, help=f"time for training ({MINUTES:g})")
    parser.add_argument("--rate", type=float, default=RATE, help=f"largest learning rate ({RATE:g})")
    parser.add_argument("--threads", type=int, default=1, help="threads of the network's arithmetic (1)")
    parser.add_argument("--seed", type=int, default=0, help="of order and augmentation (0)")


def run(options: argparse.Namespace) -> None:
    """Fine-tune as the options say."""
    # PyTorch is only wanted once the labels are known to be usable
    folder = options.project or options.labels.resolve().parent.parent.parent
    labels, view = read_labels(options.labels), read_camera(options.camera)
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
        jaw: jaw file, or the name of a shipped jaw.
        sides: which jaws are labelled.
        mapping: names of the jaw's points by body part, where they differ.

    Raises:
        LabelFileError: an image is missing or of another size, or hardly any picture shows a labelled jaw.
        NamingError: the body parts are not the jaws' key points.
    """
    left = load_jaw(jaw)
    jaws = {side: left if side == "left" else left.mirrored() for side in sides}
    rows = build_name_map(labels.names, jaws, mapping).rows
    found = []
    for number, name in enumerate(tqdm(labels.images, desc="images", leave=False)):
        image = read_image(folder / name)
        for side, own in jaws.items():
            labelled = LabelledImage(image=image, points=labels.points[number, rows[side]])
            found.append(rectify(labelled, own, side, view))
    usable = [picture for picture in found if picture is not None]
    if len(usable) < FEWEST:
        raise LabelFileError(
            f"{len(usable)} of {len(found)} pictures show a jaw with its reference point or a key point near its base; "
            f"expected at least {FEWEST}, better 50 to 300"
        )
    return FingerPictures.join(usable)


def read_image(path: Path) -> NDArray:
    """Return an image file as (h, w, 3) uint8 RGB.

    Raises:
        LabelFileError: the file is missing, or no image.
    """
    cv2 = import_cv2()
    image = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() else None
    if image is None:
        raise LabelFileError(f"{path}: no image there; expected it below the project's folder (--project)")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


if __name__ == "__main__":
    main()
