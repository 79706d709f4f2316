"""Points that a network in training finds in labelled pictures."""

from __future__ import annotations

import numpy as np

from finforce_keypoints.networks.model import DecodingRule, decode
from training.dataset import LabelledPictures
from training.loading import stack_centres
from training.network import LOCREF_STD, STRIDE, KeypointNetwork
from training.optional import import_torch
from training.scoring import Detections

torch = import_torch()

RULE = DecodingRule(stride=STRIDE, locref_std=LOCREF_STD, apply_sigmoid=True)
BATCH = 50  # pictures at once; more take memory and save no time


def detect(network: KeypointNetwork, pictures: LabelledPictures) -> Detections:
    """Return what a network in evaluation mode finds in the middle of padded pictures, decoded as DeepLabCut does."""
    parts = []
    for start in range(0, len(pictures), BATCH):
        batch = stack_centres(pictures.take(np.arange(start, min(start + BATCH, len(pictures)))))
        device = next(network.parameters()).device
        with torch.inference_mode():
            logits, locref = (output.float().cpu().numpy() for output in network(batch.pictures.to(device)))
        peaks = decode(logits, locref, RULE, batch.pictures.shape[2:])
        parts.append((peaks.pixels, peaks.likelihood, batch.points.numpy(), batch.visible.numpy()))
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    return Detections(**dict(zip(("pixels", "likelihood", "points", "visible"), columns, strict=True)))
