"""Further training of an exported network and its export."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import replace

from finforce_keypoints.networks.metadata import METADATA_FILE, read_metadata
from finforce_keypoints.networks.model import find_network
from training.augment import AugmentSettings
from training.dataset import LabelledPictures
from training.evaluate import detect_with_model
from training.export import Sidecar, write_network, write_sidecar
from training.losses import LossWeights
from training.recipe import Recipe
from training.scoring import FEWEST, Detections, fit_stddev
from training.trainer import Trainer, TrainingImages, train
from training.weights import read_network

DIM = 0.15  # less than in the first training: the user's light is known


def refine(options: Namespace, teaching: LabelledPictures, judging: LabelledPictures) -> Detections:
    """Train a network further, export it, and return what it finds in the pictures that judge it.

    The standard deviations stay those of the first network unless the judging pictures are many enough to measure them.
    """
    recipe = Recipe(
        minutes=options.minutes,
        rate=options.rate,
        threads=options.threads,
        seed=options.seed,
        batch=min(32, len(teaching)),
        evaluate_every=max(options.minutes / 5.0, 0.02),
        average=0.99,
    )
    metadata = read_metadata(find_network(options.network).parent / METADATA_FILE)
    network = read_network(options.network)
    trainer = Trainer(metadata.bodyparts, recipe, LossWeights(), network)
    train(trainer, TrainingImages(train=teaching, validation=judging), AugmentSettings(dim=DIM), options.output)
    sidecar = Sidecar(
        names=metadata.bodyparts,
        shape=network.shape,
        side_y=metadata.extra["plane"]["side_y"],
        pooled=bool(metadata.extra.get("pooled")),
        likelihood_stddev=metadata.likelihood_stddev,
    )
    write_network(trainer.average.module.eval(), options.output, sidecar)
    found = detect_with_model(options.output, judging)
    if found.visible.sum() >= 10 * FEWEST:
        write_sidecar(options.output, replace(sidecar, likelihood_stddev=fit_stddev(found)))
    return found
