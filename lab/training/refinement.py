"""Further training of an exported network and its export."""

from __future__ import annotations

from argparse import Namespace

from lab.training.augment import AugmentSettings
from lab.training.dataset import FingerPictures
from lab.training.export import write_network
from lab.training.recipe import Recipe
from lab.training.scoring import Score
from lab.training.trainer import Trainer, TrainingImages, train
from lab.training.weights import read_network

DIM = 0.15  # less than in the first training: the user's light is known


def refine(
    options: Namespace, teaching: FingerPictures, judging: FingerPictures, mixed: FingerPictures | None = None
) -> Score:
    """Train a network further, export it, and return its score on the pictures that judge it.

    Args:
        options: `network`, `output`, `minutes`, `rate`, `threads` and `seed`.
        teaching: a user's pictures.
        judging: pictures of theirs that it does not learn from.
        mixed: others against forgetting; half of what it sees is then theirs.
    """
    recipe = Recipe(
        minutes=options.minutes,
        rate=options.rate,
        threads=options.threads,
        seed=options.seed,
        batch=16,
        workers=0,  # a process that is split off after OpenCV or onnxruntime have made threads may wait for ever
        evaluate_every=max(options.minutes / 4.0, 0.02),
        average=0.99,
    )
    network, factor = read_network(options.network)
    everything = teaching if mixed is None else teaching.mixed_with(mixed)
    trainer = Trainer(recipe, network)
    images = TrainingImages(train=everything, validation=judging)
    score = train(trainer, images, AugmentSettings(dim=DIM), options.output)
    write_network(trainer.average.module.eval(), options.output, factor)
    return score
