"""Grasp force from a wrist camera: what all packages share, and the door to them.

`from finforce import NAME` gives what most programs need, and loads its package only then:

- images to forces: `ForceSensor` and what it returns, `GripperForces`; `CameraIntrinsics`, `read_camera`;
- the force: `ForceEstimator`, `EstimatorSettings`, `Observation`, `Contact`, `Solution`, `load_jaw`;
- the material: `load_calibration`, `save_calibration`, `calibrate_with_scale`;
- the contact: `load_object_mesh`, `ContactEstimator`, and `ForceLoop`, contact and force together;
- the images: `KeypointDetector`, `build_detector`, `RgbdImage`;
- the gripper: `Gripper`, `build_bus`; `GripperClient`, for a driver node that runs elsewhere;
- recordings: `evaluate`, which returns a table of forces; `read_recording`, `iter_frames`, `find_mesh`; `DEMO`, the one
  that comes with finforce.
"""

import ast
from importlib import import_module
from pathlib import Path
from typing import Any

# the stub, which editors read, says where every name is
_STUB = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
_HOMES = {entry.names[0].name: entry.module for entry in _STUB.body if isinstance(entry, ast.ImportFrom)}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    """Load what was asked for from its package; it stays."""
    if name not in _HOMES:
        raise AttributeError(f"module 'finforce' has no attribute {name!r}; it has {', '.join(__all__)}")
    value = globals()[name] = getattr(import_module(_HOMES[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
