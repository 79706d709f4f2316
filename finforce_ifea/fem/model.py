"""What every mechanical model of a jaw offers to the solvers."""

from dataclasses import dataclass
from typing import Any, Literal, Protocol

from numpy.typing import NDArray

from finforce_ifea.fem.factorisation import Factor

LARGEST_MOVE, LARGEST_TURN = 2e-3, 0.3
Across = Literal["middle", "half", "both"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Linearization:
    """One state of a model.

    Attributes:
        force: internal force of the unknowns (n,) [N].
        energy: elastic energy [J].
        smallest_det: smallest det F of all elements [-]; at or below zero the mesh has turned inside out.
        tangent: stored tangent stiffness, to be passed to `stiffen` and `factorise`; None when not asked for.
    """

    force: NDArray
    energy: float
    smallest_det: float
    tangent: Any


class JawModel(Protocol):
    """A geometrically nonlinear jaw with unknowns q, shape (size,) [m or rad].

    Attributes:
        size: number of unknowns.
        across: where along y contact points stand: in the "middle" of a planar model, on "half" of the width where each
            stands for its mirror image too, or on "both" halves.
        rotations: which unknowns are rotations (size,) bool; None when all are of one kind.
        reach: largest change of each unknown at once (size,), or of all: 2 mm, 0.3 rad.
    """

    size: int
    across: Across
    rotations: NDArray | None
    reach: NDArray | float

    def linearize(self, q: NDArray, *, tangent: bool = True) -> Linearization:
        """Evaluate internal force, energy and, unless `tangent` is False, the tangent stiffness at q."""
        ...

    def attach(self, points: NDArray, max_distance: float) -> Any:
        """Return a probe of material points (p, 3) [m, undeformed, jaw frame]; raises MeshError when off the jaw."""
        ...

    def positions(self, probe: Any, q: NDArray) -> NDArray:
        """Return the deformed positions (p, 3) [m] of a probe."""
        ...

    def project(self, probe: Any, q: NDArray, modes: NDArray) -> NDArray:
        """Return the motions (p, 3, k) [m] of a probe for changes modes (size, k) of the unknowns."""
        ...

    def load(self, probe: Any, q: NDArray, forces: NDArray) -> NDArray:
        """Return the generalised load (size,) of forces (p, 3) [N] at a probe's points."""
        ...

    def stiffen(self, tangent: Any, probe: Any, q: NDArray, blocks: NDArray) -> None:
        """Add springs blocks (p, 3, 3) [N/m] at a probe's points to a stored tangent, in place."""
        ...

    def factorise(self, tangent: Any) -> Factor:
        """Factorise a stored tangent."""
        ...

    def vertices(self, q: NDArray) -> NDArray:
        """Return the deformed mesh vertices (v, 3) [m], in mesh order."""
        ...
