"""A network with more channels that finds what a narrower one finds, to go on training from."""

from __future__ import annotations

from dataclasses import replace

from lab.training.errors import RecipeError
from lab.training.network import FingerNetwork, NetworkShape
from lab.training.optional import import_torch

torch = import_torch()


def widen(network: FingerNetwork, coarse: tuple[int, ...], fine: tuple[int, ...], seed: int = 0) -> FingerNetwork:
    """Return a network with at least as many channels, and the same outputs for the same inputs.

    New channels begin with weights by chance, and nothing listens to them yet (T. Chen et al., Net2Net, ICLR 2016, with
    new units instead of copied ones).

    Args:
        network: to begin with.
        coarse: channels of the wider coarse part, as in `NetworkShape`.
        fine: channels of the wider fine part.
        seed: of the new channels' weights.

    Raises:
        RecipeError: other numbers of channels than the network has, or fewer.
    """
    old, new = (*network.shape.coarse, *network.shape.fine), (*coarse, *fine)
    if len(coarse) != 4 or len(fine) != 2 or any(more < less for less, more in zip(old, new, strict=True)):
        raise RecipeError(
            f"got channels {coarse}, {fine}; expected {network.shape.coarse}, {network.shape.fine} or more"
        )
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        wide = FingerNetwork(replace(network.shape, coarse=tuple(coarse), fine=tuple(fine)))
    state, own = dict(network.state_dict()), wide.state_dict()
    heard = _judged_channels(network.shape, wide.shape)
    for name, value in own.items():
        if name in state and state[name].shape != value.shape:
            columns = heard if name == "fine.judge.0.weight" else None
            own[name] = _enlarge(state[name], value, columns)
        elif name in state:
            own[name] = state[name]
    wide.load_state_dict(own)
    return wide.train(network.training)


def _judged_channels(old: NetworkShape, new: NetworkShape) -> torch.Tensor:
    """Return which inputs of the wider judge are those of the narrower one: two of the fine part, the coarse one's."""
    sizes = [(old.fine[1], new.fine[1])] * 2 + [(old.coarse[1], new.coarse[1])]
    starts = [0, new.fine[1], 2 * new.fine[1]]
    return torch.cat([start + torch.arange(few) for start, (few, _) in zip(starts, sizes, strict=True)])


def _enlarge(old: torch.Tensor, new: torch.Tensor, columns: torch.Tensor | None) -> torch.Tensor:
    """Return a parameter whose first rows are the old ones and do not listen to new channels; others stay by chance."""
    large = new.clone()
    if old.ndim < 2:
        large[: len(old)] = old
        return large
    large[: len(old)] = 0.0
    inputs = torch.arange(old.shape[1]) if columns is None else columns
    large[: len(old), inputs] = old
    return large
