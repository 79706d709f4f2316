"""Files that hold a training at one moment, to go on from or to export."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lab.training.errors import CheckpointError
from lab.training.network import FingerNetwork, NetworkShape
from lab.training.optional import import_torch

torch = import_torch()


@dataclass(frozen=True, kw_only=True, eq=False)
class Checkpoint:
    """A training at one moment.

    Attributes:
        shape: of the network.
        averaged: state of the averaged network, the one to use.
        network: state of the network that is trained.
        optimizer: its state.
        step: batches seen.
        elapsed: time spent on them [s].
    """

    shape: NetworkShape
    averaged: Mapping[str, Any]
    network: Mapping[str, Any]
    optimizer: Mapping[str, Any]
    step: int
    elapsed: float


def save_checkpoint(path: str | Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint; the file before it stays whole until the new one is complete."""
    content = {name: getattr(checkpoint, name) for name in checkpoint.__dataclass_fields__}
    content["shape"] = asdict(checkpoint.shape)
    save_whole(content, Path(path))


def save_whole(content: Mapping[str, Any], path: Path) -> None:
    """Write what torch can; the file before it stays whole until the new one is complete."""
    part = path.with_suffix(".part")
    torch.save(content, part)
    part.replace(path)


def load_checkpoint(path: str | Path) -> Checkpoint:
    """Read a checkpoint.

    Raises:
        CheckpointError: the file is missing, or no checkpoint.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        return Checkpoint(**content | {"shape": shape_from(content["shape"])})
    except Exception as error:  # torch raises whatever its unpickler does
        reason = str(error).partition("\n")[0]
        raise CheckpointError(f"{path}: {reason}; expected a checkpoint written by training.train") from error


def shape_from(content: Mapping[str, Any]) -> NetworkShape:
    """Return the sizes of a network from what a file says of them."""
    return NetworkShape(**{name: tuple(value) if isinstance(value, list) else value for name, value in content.items()})


def build_averaged(checkpoint: Checkpoint) -> FingerNetwork:
    """Return the averaged network of a checkpoint, in evaluation mode."""
    network = FingerNetwork(checkpoint.shape)
    network.load_state_dict(checkpoint.averaged)
    return network.eval()
