"""A lens that takes noise for pictures, and knows the truth about them: no renderer."""

from threading import Lock

import numpy as np
from rgbd_fakes import CAMERA

from finforce.camera import project
from finforce.gripper_frames import ROBOT_CAMERA, jaw_in_camera
from finforce_twin.rendering.photographer import SceneSetting, Shot, TrueKeypoints, WristView

CAMERA_POSE = ROBOT_CAMERA


class FakeLens:
    """Takes what `Photographer` takes, of 64 x 48 pixels; every key point is visible."""

    def __init__(self):
        self.setting = SceneSetting(shapes={}, mesh=None, camera=CAMERA, T_gripper_camera=CAMERA_POSE)
        self.looks = 0
        self._lock = Lock()

    def look(self, state):
        with self._lock:
            self.looks += 1
        return WristView(picture=None, truth={side: self._find(state, side) for side in state.jaws})

    def develop(self, view, stamp):
        rng = np.random.default_rng(round(stamp * 1e6))
        size = (CAMERA.height, CAMERA.width)
        depth = rng.uniform(0.1, 0.2, size).astype(np.float32)
        return Shot(color=rng.integers(0, 255, (*size, 3), dtype=np.uint8), depth=depth, truth=view.truth)

    def _find(self, state, side):
        jaw = state.jaws[side]
        T = jaw_in_camera(CAMERA_POSE, side, jaw.origin_x)
        points = np.vstack((jaw.keypoints, jaw.reference))
        pixels = project(points @ T[:3, :3].T + T[:3, 3], CAMERA)
        return TrueKeypoints(T_camera_jaw=T, points=points, pixels=pixels, visible=np.ones(len(points), bool))
