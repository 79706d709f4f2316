"""Trains the key point network: `python -m lab.training.train DATASET -o RUN`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from lab.training.arguments import add_settings, one_line_errors, settings_from
from lab.training.augment import AugmentSettings
from lab.training.checkpoint import load_checkpoint
from lab.training.dataset import TRAIN, VALIDATION, load_pictures
from lab.training.errors import RecipeError
from lab.training.network import FingerNetwork
from lab.training.recipe import Recipe
from lab.training.trainer import CHECKPOINT, Trainer, TrainingImages, train
from lab.training.weights import read_network
from lab.training.widen import widen


def main(arguments: Sequence[str] | None = None) -> None:
    """Train on the shards of a folder and leave log and checkpoint in another one."""
    options = build_parser().parse_args(arguments)
    with one_line_errors():
        run(options)


def build_parser() -> argparse.ArgumentParser:
    """Return the options of the command."""
    parser = argparse.ArgumentParser(prog="python -m lab.training.train", description=__doc__)
    parser.add_argument("dataset", type=Path, help="folder of shards train_*.npz and val_*.npz")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the run")
    parser.add_argument("--limit", type=int, help="train on the first so many pictures only")
    parser.add_argument("--network", type=Path, help="begin with the weights of an exported network")
    parser.add_argument(
        "--widen", type=_read_channels, help="give that network so many channels: coarse A,B,C,D, fine E,F"
    )
    parser.add_argument("--fine", action="store_true", help="train the fine part alone, leave the coarse one as it is")
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint in the folder of the run")
    add_settings(parser, Recipe)
    add_settings(parser.add_argument_group("augmentation"), AugmentSettings)
    return parser


def run(options: argparse.Namespace) -> None:
    """Train as the options say."""
    recipe = settings_from(options, Recipe)
    pictures = TrainingImages(
        train=load_pictures(options.dataset, TRAIN, options.limit),
        validation=load_pictures(options.dataset, VALIDATION, recipe.validation),
    )
    if options.resume:
        checkpoint = load_checkpoint(options.output / CHECKPOINT)
        trainer = Trainer(recipe, FingerNetwork(checkpoint.shape))
        trainer.resume(checkpoint)
    else:
        trainer = Trainer(recipe, _begin(options))
    trainer.network.coarse.requires_grad_(not options.fine)
    print(train(trainer, pictures, settings_from(options, AugmentSettings), options.output))


def _begin(options: argparse.Namespace) -> FingerNetwork | None:
    """Return the network to begin with, none for one by chance."""
    if options.network is None:
        if options.widen:
            raise RecipeError("--widen: there is no network to widen; expected --network FOLDER")
        return None
    network = read_network(options.network)[0]
    return widen(network, options.widen[:4], options.widen[4:], options.seed) if options.widen else network


def _read_channels(text: str) -> tuple[int, ...]:
    """Return six whole numbers."""
    parts = text.split(",")
    if len(parts) != 6 or not all(part.strip().isdigit() for part in parts):
        raise argparse.ArgumentTypeError(f"{text[:40]!r}: expected six numbers, as 32,64,96,128,24,64")
    return tuple(int(part) for part in parts)


if __name__ == "__main__":
    main()
