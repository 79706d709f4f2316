"""Images, intrinsics and true key points as the contents of messages."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics
from finforce_twin.gripper.footage import TrueJaw

FARTHEST = 65535.0  # steps in 16 bits


def encode_depth(depth: NDArray, step: float = 1e-3) -> NDArray[np.uint16]:
    """Return a depth image (h, w) [m] in steps [m], 0 where it is NaN or too far for 16 bits."""
    steps = np.round(np.nan_to_num(np.asarray(depth, dtype=np.float64), nan=0.0, posinf=0.0, neginf=0.0) / step)
    return np.where((steps > 0.0) & (steps <= FARTHEST), steps, 0.0).astype(np.uint16)


def info_fields(camera: CameraIntrinsics) -> dict[str, Any]:
    """Return the numbers of a sensor_msgs/CameraInfo: size, model, d, k, r, p."""
    k = np.array([camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0])
    p = np.array([camera.fx, 0.0, camera.cx, 0.0, 0.0, camera.fy, camera.cy, 0.0, 0.0, 0.0, 1.0, 0.0])
    return {
        "height": camera.height,
        "width": camera.width,
        "distortion_model": "plumb_bob",
        "d": np.array(camera.distortion, dtype=np.float64),
        "k": k,
        "r": np.eye(3).ravel(),
        "p": p,
    }


def sight_columns(jaw: TrueJaw) -> dict[str, NDArray]:
    """Return the columns of a cloud of true key points: x y z [m] jaw frame, u v [px], visible."""
    columns = {axis: jaw.points[:, i].astype(np.float32) for i, axis in enumerate("xyz")}
    columns |= {name: jaw.pixels[:, i].astype(np.float32) for i, name in enumerate("uv")}
    return {**columns, "visible": jaw.visible.astype(np.uint8)}
