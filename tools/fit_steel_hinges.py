"""Learns where the hinge screws of the measured steel finger sit and where its strips leave the clamp.

Only the six pictures, their base displacements and the object's radius are used; no force is read. Prints the lines for
finforce_ifea/jaw/jaws/steel.yaml.
"""

import json
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from finforce_eval.cli.convert_steel import SHIPPED, points_from_picture
from finforce_ifea.jaw.drawing import Drawing
from finforce_ifea.jaw.jaw import Jaw, load_jaw
from finforce_ifea.mechanics import build_mechanics
from finforce_ifea.settings import EstimatorSettings
from lab.forward_press import RigidCylinder, follow_points, press_jaw

# What a clamp may be off by [m]; the hinges are free.
_CLAMP_STDDEV = 0.003
_PICKING_STDDEV = 0.5e-3


def main() -> None:
    """Fit and print."""
    measurement = json.loads(SHIPPED.read_text(encoding="utf-8"))
    pictures = np.stack([points_from_picture(nodes) for nodes in measurement["nodes"]])[:, :, [0, 2]]
    depths = 1e-3 * np.asarray(measurement["displacement_mm"], dtype=float)
    radius = 1e-3 * float(measurement["object"]["radius_mm"])
    jaw = load_jaw("steel")
    drawing = replace(jaw.drawing, clamped_z=0.0)
    drawn = drawing.junctions.reshape(-1, 2)

    def offsets(x: np.ndarray) -> np.ndarray:
        return pictures - press(jaw, drawing, drawn, radius, depths, clamp=1e-3 * abs(x[0]), height=1e-3 * x[1])

    def cost(x: np.ndarray) -> float:
        left = offsets(x)
        left = left - left.mean(axis=0)
        return float((left**2).sum() / _PICKING_STDDEV**2 + (1e-3 * x[0] / _CLAMP_STDDEV) ** 2)

    best = minimize(cost, [2.0, 66.0], method="Nelder-Mead", options={"xatol": 0.05, "fatol": 0.1})
    mean = offsets(best.x).mean(axis=0)
    left = offsets(best.x) - mean
    print(f"# picking scatter {1e3 * np.sqrt((left**2).mean()):.2f} mm, object at z = {best.x[1]:.1f} mm")
    print(f"  clamped_z: {1e-3 * abs(best.x[0]):.4f}")
    for name, (x, z) in zip(jaw.keypoint_names, drawn + mean, strict=True):
        print(f"  {name}: [{x:.5f}, 0.0, {z:.5f}]")


def press(
    jaw: Jaw, drawing: Drawing, drawn: np.ndarray, radius: float, depths: np.ndarray, *, clamp: float, height: float
) -> np.ndarray:
    """Return the drawn hinge points (depths, hinges, 2) [m] of the finger pressed on a cylinder."""
    finger = replace(jaw, drawing=replace(drawing, clamped_z=clamp))
    mechanics = build_mechanics(finger, EstimatorSettings())
    presses = press_jaw(
        mechanics.model, mechanics.contact.surface, finger.inner_face_x, RigidCylinder(radius=radius), height, depths
    )
    return follow_points(mechanics.model, np.insert(drawn, 1, 0.0, axis=1), presses)[1:, :, [0, 2]]


if __name__ == "__main__":
    main()
