"""Closed loops made of directed edges; knows indices only."""

import numpy as np
from numpy.typing import NDArray


def chain_loops(starts: NDArray, stops: NDArray) -> list[NDArray]:
    """Return closed loops that together run along each edge once.

    Edges that do not close are left out; where every node has as many edges in as out, none is.

    Args:
        starts: (e,) node at which each edge begins.
        stops: (e,) node at which it ends.

    Returns:
        Node indices (n,) of each loop in its order; the last is joined to the first.
    """
    ways: dict[int, list[int]] = {}
    for start, stop in zip(starts.tolist(), stops.tolist(), strict=True):
        ways.setdefault(start, []).append(stop)
    loops = []
    for start in list(ways):
        while ways[start]:
            loop = _follow(ways, start)
            if loop:
                loops.append(np.array(loop))
    return loops


def _follow(ways: dict[int, list[int]], start: int) -> list[int]:
    """Take edges from the ways until back at the start; nothing when the way ends before."""
    loop, node = [], start
    while True:
        loop.append(node)
        onward = ways.get(node)
        if not onward:
            return []
        node = onward.pop()
        if node == start:
            return loop
