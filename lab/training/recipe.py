"""The settings of one training."""

from __future__ import annotations

from dataclasses import dataclass

from finforce.settings import check_bounds, setting
from lab.training.errors import RecipeError


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """How long and how fast a network is trained; a run ends after its minutes, whatever it has seen by then."""

    minutes: float = setting(80.0, "time that training may take, evaluation included", "min", 0.01, 10_000.0)
    steps: int = setting(0, "batches until the end; 0: until the minutes are over, not repeatable", "", 0, 10**9)
    seed: int = setting(0, "of weights, order and augmentation", "", 0, 2**31)
    batch: int = setting(32, "pictures per step", "", 1, 4096)
    rate: float = setting(2e-3, "largest learning rate of AdamW", "", 1e-6, 1.0)
    warm_up: float = setting(0.04, "part of the time in which the rate rises", "-", 0.0, 0.5)
    decay: float = setting(1e-2, "weight decay of AdamW", "", 0.0, 1.0)
    clip: float = setting(5.0, "largest norm of the gradient", "", 1e-3, 1e6)
    threads: int = setting(1, "threads of the network's arithmetic", "", 1, 256)
    evaluate_every: float = setting(5.0, "time between evaluations and checkpoints", "min", 0.01, 10_000.0)

    def __post_init__(self) -> None:
        check_bounds(self, RecipeError)


@dataclass(frozen=True, kw_only=True)
class Recipe(Schedule):
    """How the network of key points is trained."""

    average: float = setting(0.998, "part of the averaged weights that stays in each step", "", 0.0, 0.99999)
    workers: int = setting(1, "processes that make batches", "", 0, 256)
    validation: int = setting(1000, "pictures that an evaluation uses", "", 1, 1_000_000)
