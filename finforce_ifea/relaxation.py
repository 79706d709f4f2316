"""The finger's relaxation: a linear viscoelastic filter from elastic to measured force.

The force of the shape is F_e; the material adds overstresses that decay, F = F_e + sum_i h_i with
h_i' = -h_i / tau_i + g_i F_e' (generalised Maxwell model, Simo and Hughes, Computational Inelasticity, 1998, ch. 10).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from finforce.compiled import njit
from finforce.typed_yaml import FileModel, Number


class RelaxationTerm(FileModel):
    """One branch of the relaxation."""

    share: Number = Field(ge=0.0, le=10.0, description="Share g of the elastic stiffness that relaxes [-]")
    time_constant: Number = Field(ge=1e-3, le=1e6, description="Time constant tau [s]")


class Relaxation:
    """The state of all branches for a force of three components."""

    def __init__(self, terms: Sequence[RelaxationTerm]) -> None:
        """Start relaxed."""
        self._share = np.array([term.share for term in terms], float)
        self._tau = np.array([term.time_constant for term in terms], float)
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self._over = np.zeros((len(self._share), 3))
        self._elastic = np.zeros(3)

    def update(self, elastic: NDArray, dt: float) -> NDArray:
        """Return the measured force (3,) [N] for the elastic force (3,) [N] after dt [s], exact for a ramp between."""
        out = np.empty(3)
        relax_force(np.asarray(elastic, float), self.packed, dt, out)
        return out

    def doubt(self, change: NDArray, dt: float) -> None:
        """Add the standard deviation of the overstress of a force that changed by (3,) [N] within the last dt [s].

        When is not known: what is left of its overstress is as likely to be anything from all to that of a change at
        the beginning, while `update` takes a ramp.
        """
        _doubt(self._over, self._share, self._tau, np.asarray(change, float), dt)

    @property
    def overstress(self) -> NDArray:
        """The overstress that remains of past forces (3,) [N]."""
        return self._over.sum(axis=0)

    @property
    def packed(self) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """The last elastic force (3,) and overstresses (n, 3) [N], shares and time constants (n,) of `relax_force`."""
        return self._elastic, self._over, self._share, self._tau


def invert_relaxation(measured: NDArray, stamps: NDArray, terms: Sequence[RelaxationTerm]) -> NDArray:
    """Return the elastic forces (n,) [N] that relax into measured ones (n,) [N] at stamps (n,) [s]."""
    share = np.array([term.share for term in terms])
    tau = np.array([term.time_constant for term in terms])
    return _invert(np.asarray(measured, float), np.asarray(stamps, float), share, tau)


def apply_relaxation(elastic: NDArray, stamps: NDArray, terms: Sequence[RelaxationTerm]) -> NDArray:
    """Return the measured forces (n,) [N] for elastic ones (n,) [N] at stamps (n,) [s]; see `Relaxation.update`."""
    share = np.array([term.share for term in terms])
    tau = np.array([term.time_constant for term in terms])
    return _relax(np.asarray(elastic, float), np.asarray(stamps, float), share, tau)


@njit(cache=True)
def _relax(elastic, stamps, share, tau):
    total, over = elastic.copy(), np.zeros(len(share))
    for i in range(1, len(elastic)):
        ratio = np.maximum((stamps[i] - stamps[i - 1]) / tau, 1e-12)
        over = over * np.exp(-ratio) - share * np.expm1(-ratio) / ratio * (elastic[i] - elastic[i - 1])
        total[i] = max(0.0, elastic[i] + over.sum())
    return total


@njit(cache=True)
def _invert(measured, stamps, share, tau):
    elastic, over = np.zeros(len(measured)), np.zeros(len(share))
    for i in range(1, len(measured)):
        rest, stiffness = measured[i], 1.0
        ratio = np.maximum((stamps[i] - stamps[i - 1]) / tau, 1e-12)
        decay, gain = np.exp(-ratio), -np.expm1(-ratio) / ratio * share
        for k in range(len(share)):
            rest += gain[k] * elastic[i - 1] - over[k] * decay[k]
            stiffness += gain[k]
        elastic[i] = rest / stiffness
        over = over * decay + gain * (elastic[i] - elastic[i - 1])
    return elastic


@njit(cache=True)
def _doubt(over, share, tau, change, dt):
    """Add to overstresses (n, 3) what `Relaxation.doubt` says."""
    for k in range(len(share)):
        ratio = max(dt / tau[k], 1e-12)
        decay = np.exp(-ratio)
        spread = share[k] * np.hypot((1.0 - decay) / np.sqrt(12.0), 0.5 * (1.0 + decay) + np.expm1(-ratio) / ratio)
        for a in range(3):
            over[k, a] = np.copysign(np.hypot(over[k, a], spread * change[a]), over[k, a])


@njit(cache=True)
def relax_force(elastic, relaxation, dt, out):
    """Write to out the force (3,) [N] for an elastic one (3,) [N] after dt [s]; see `Relaxation.packed`."""
    before, over, share, tau = relaxation
    for a in range(3):
        out[a] = elastic[a]
    for k in range(len(share)):
        ratio = max(dt / tau[k], 1e-12)
        decay, gain = np.exp(-dt / tau[k]), -np.expm1(-ratio) / ratio
        for a in range(3):
            over[k, a] = over[k, a] * decay + share[k] * gain * (elastic[a] - before[a])
            out[a] += over[k, a]
    ahead = 0.0
    for a in range(3):
        before[a] = elastic[a]
        ahead += out[a] * elastic[a]
    # contact cannot pull: the overstress may take the whole force away, never turn it round
    if not ahead > 0.0:
        for a in range(3):
            out[a] = 0.0
