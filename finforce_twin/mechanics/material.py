"""The material of a synthetic gripper, drawn anew for every seed as printed parts differ."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finforce_ifea.jaw.jaw_file import Material
from finforce_ifea.relaxation import Relaxation, RelaxationTerm, invert_relaxation

# Printed parts are stiffer than the data sheet says; two parts of one print differ less than two prints.
_STIFFER, _PART_STDDEV = (1.1, 1.4), 0.02
_SHARE = (0.04, 0.09)
_TIMES = ((1.5, 3.0), (7.0, 14.0))  # [s]


@dataclass(frozen=True, kw_only=True, eq=False)
class PrintedMaterial:
    """What the jaws of one gripper are made of.

    Attributes:
        elastic: of each side.
        terms: of the relaxation, the same in both jaws, so that relaxed forces balance as elastic ones do.
    """

    elastic: Mapping[str, Material]
    terms: tuple[RelaxationTerm, ...]


def draw_material(datasheet: Material, sides: Sequence[str], rng: np.random.Generator) -> PrintedMaterial:
    """Returns a material about that of the data sheet, with two branches of relaxation."""
    modulus = datasheet.young_modulus * rng.uniform(*_STIFFER)
    parts = {side: float(modulus * np.exp(_PART_STDDEV * rng.standard_normal())) for side in sides}
    terms = tuple(
        RelaxationTerm(share=float(rng.uniform(*_SHARE)), time_constant=float(rng.uniform(*times))) for times in _TIMES
    )
    elastic = {
        side: Material(young_modulus=value, poisson_ratio=datasheet.poisson_ratio) for side, value in parts.items()
    }
    return PrintedMaterial(elastic=elastic, terms=terms)


def find_elastic_weight(weight: NDArray, stamps: NDArray, terms: Sequence[RelaxationTerm]) -> NDArray:
    """Returns the loads (n, 3) [N] that an elastic jaw must carry so that the relaxed forces are the weight (n, 3) [N].

    Under a steady weight the jaws creep: their shape is that of a load which grows from less than the weight to it.
    """
    return np.stack([invert_relaxation(column, stamps, terms) for column in weight.T], axis=1)


class RelaxedWrench:
    """Force and torque on one jaw as its material gives way; both by the same linear filter."""

    def __init__(self, terms: Sequence[RelaxationTerm]) -> None:
        """Starts relaxed."""
        self._force, self._torque = Relaxation(terms), Relaxation(terms)

    def update(self, force: NDArray, torque: NDArray, dt: float) -> tuple[NDArray, NDArray]:
        """Returns force (3,) [N] and torque (3,) [N m] for the elastic ones, dt [s] later; no torque without force."""
        relaxed, turned = self._force.update(force, dt), self._torque.update(torque, dt)
        return relaxed, turned if relaxed.any() else np.zeros(3)
