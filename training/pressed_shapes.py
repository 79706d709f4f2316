"""Shapes of a jaw under many objects, by the forward mechanics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from finforce.errors import FinforceError
from finforce_ifea.contact_mechanics.forward_press import PressState, RigidBox, RigidCylinder, RigidObject, press_jaw
from finforce_ifea.contact_mechanics.pressed_jaw import Mechanics
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.mechanics import build_mechanics
from finforce_ifea.settings import EstimatorSettings

DEPTHS = np.array([0.8, 2.0, 3.5, 5.0, 7.0, 9.0, 11.0, 13.0]) * 1e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class PressedShape:
    """A left jaw in equilibrium with an object whose axis lies along y.

    Attributes:
        vertices: (n, 3) [m], jaw frame.
        keypoints: (K, 3) [m].
        size: of the object along x and z [m].
        is_round: a cylinder, else a box.
        centre: (2,) x and z of the object's centre [m].
    """

    vertices: NDArray
    keypoints: NDArray
    size: NDArray
    is_round: bool
    centre: NDArray


def draw_pressed_shapes(jaw: Jaw, count: int, seed: int) -> list[PressedShape]:
    """Return the shapes of a left jaw under `count` objects by chance, several depths each.

    Raises:
        FinforceError: the jaw's mesh or model is bad.
    """
    rng = np.random.default_rng(seed)
    mechanics = build_mechanics(jaw, EstimatorSettings())
    probe = mechanics.model.attach(jaw.keypoints, 3e-3)
    shapes: list[PressedShape] = []
    low, high = jaw.candidates[:, 2].min(), jaw.candidates[:, 2].max()
    for _ in tqdm(range(count), desc="shapes", disable=None):
        is_round = rng.random() < 0.7
        size = np.full(2, rng.uniform(8e-3, 55e-3)) if is_round else rng.uniform(8e-3, 50e-3, 2)
        rigid = (
            RigidCylinder(radius=0.5 * size[0])
            if is_round
            else RigidBox(size_x=size[0], size_z=size[1], edge_radius=min(2e-3, 0.2 * size.min()))
        )
        height = rng.uniform(low, high)
        for press in _press(mechanics, jaw, rigid, height, np.sort(DEPTHS * rng.uniform(0.85, 1.15))):
            shapes.append(
                PressedShape(
                    vertices=mechanics.model.vertices(press.q),
                    keypoints=mechanics.model.positions(probe, press.q),
                    size=size,
                    is_round=is_round,
                    centre=np.array([jaw.inner_face_x + 0.5 * size[0] - press.depth, height]),
                )
            )
    return shapes


def _press(mechanics: Mechanics, jaw: Jaw, rigid: RigidObject, height: float, depths: NDArray) -> list[PressState]:
    """Return the equilibria down to the deepest that there is."""
    contact = mechanics.contact
    for count in range(len(depths), 0, -1):
        try:
            return press_jaw(mechanics.model, contact.surface, jaw.inner_face_x, rigid, height, depths[:count])
        except FinforceError:
            continue
    return []
