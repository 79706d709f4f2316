"""The settings of one training."""

from __future__ import annotations

from dataclasses import dataclass

from finforce.settings import check_bounds, setting
from training.errors import RecipeError


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """How a network is trained; a run ends after its minutes, whatever it has seen by then."""

    minutes: float = setting(80.0, "min", 0.01, 10_000.0, "time that training may take, evaluation included")
    steps: int = setting(0, "", 0, 10**9, "batches until the end; 0: until the minutes are over, not repeatable")
    seed: int = setting(0, "", 0, 2**31, "of weights, order and augmentation")
    batch: int = setting(48, "", 1, 4096, "pictures per step")
    rate: float = setting(3e-3, "", 1e-6, 1.0, "largest learning rate of AdamW")
    warm_up: float = setting(0.04, "-", 0.0, 0.5, "part of the time in which the rate rises")
    decay: float = setting(1e-2, "", 0.0, 1.0, "weight decay of AdamW")
    clip: float = setting(5.0, "", 1e-3, 1e6, "largest norm of the gradient")
    average: float = setting(0.998, "", 0.0, 0.99999, "part of the averaged weights that stays in each step")
    threads: int = setting(1, "", 1, 256, "threads of the network's arithmetic")
    workers: int = setting(1, "", 0, 256, "processes that make batches")
    evaluate_every: float = setting(5.0, "min", 0.01, 10_000.0, "time between evaluations and checkpoints")
    validation: int = setting(1000, "", 1, 1_000_000, "pictures that an evaluation uses")

    def __post_init__(self) -> None:
        check_bounds(self, RecipeError)
