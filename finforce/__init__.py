"""Grasp force from a wrist camera: what all packages share, and the door to them.

`from finforce import NAME` gives what most programs need, and loads its package only then:

- the force: `load_jaw`, `load_calibration`, `JawEstimator`, `Observation`, `Contact`, `Solution`;
- the contact: `load_object_mesh`, `ContactEstimator`, and `ForceLoop`, contact and force together;
- the images: `KeypointDetector`, `build_detector`, `RgbdImage`;
- the gripper: `Gripper`, `build_bus`; `GripperClient`, for a driver node that runs elsewhere;
- recordings: `read_recording`, `play`, `find_mesh`, `DEMO`, the one that comes with finforce.
"""

from importlib import import_module
from typing import Any

_HOMES = {
    "Contact": "finforce_ifea.observation",
    "ContactEstimator": "finforce_contact.estimator",
    "DEMO": "finforce_eval.recordings.recording",
    "ForceLoop": "finforce_contact.loop",
    "Gripper": "finforce_driver.gripper",
    "GripperClient": "finforce.ros.client",
    "JawEstimator": "finforce_ifea.estimator",
    "KeypointDetector": "finforce_keypoints.detector",
    "Observation": "finforce_ifea.observation",
    "RgbdImage": "finforce_keypoints.images",
    "Solution": "finforce_ifea.observation",
    "build_bus": "finforce_driver.can",
    "build_detector": "finforce_keypoints.build",
    "find_mesh": "finforce_eval.recordings.objects",
    "load_calibration": "finforce_ifea.jaw.calibration",
    "load_jaw": "finforce_ifea.jaw.jaw",
    "load_object_mesh": "finforce_contact.mesh.object_mesh",
    "play": "finforce_eval.recordings.objects",
    "read_recording": "finforce_eval.recordings.recording",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    """Load what was asked for from its package; it stays."""
    if name not in _HOMES:
        raise AttributeError(f"module 'finforce' has no attribute {name!r}; it has {', '.join(__all__)}")
    value = globals()[name] = getattr(import_module(_HOMES[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
