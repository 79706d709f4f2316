"""Depth pictures of fin-ray jaws, and a finder that knows the truth and errs as told, for tests of the detector."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from finforce.camera import CameraIntrinsics, project
from finforce.gripper_frames import BENCH_CAMERA, BENCH_ORIGIN_X, ROBOT_CAMERA, jaw_in_camera
from finforce_contact.mesh.triangles import ObjectMesh
from finforce_contact.mesh.views import MeshView
from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints.detector import KeypointDetector
from finforce_keypoints.images import RgbdImage
from finforce_keypoints.pixel_finder import PixelFinding
from finforce_keypoints.settings import DetectorSettings
from finforce_twin.rendering.depth_camera import D405_DISTORTION, DepthNoise, disturb_depth

CAMERA = CameraIntrinsics(
    width=640, height=480, fx=431.2, fy=430.0, cx=319.6, cy=241.3, distortion=np.array(D405_DISTORTION)
)
REFERENCE = np.array([0.0, 0.010, -0.006])
BACKGROUND = 0.35
VIEWS = {
    "robot": (ROBOT_CAMERA, {"left": -0.040, "right": 0.040}),
    "bench": (BENCH_CAMERA, {"left": BENCH_ORIGIN_X}),
}


def load_jaws(sides):
    """The bench jaws with the reference point on their holders."""
    mirror = {"left": REFERENCE, "right": REFERENCE * (1.0, -1.0, 1.0)}
    return {side: replace(load_jaw("bench", side), reference_point=mirror[side]) for side in sides}


@dataclass(frozen=True)
class Bend:
    """A smooth deformation: push along -x around a height, lean along y towards the tip."""

    push: float = 0.0
    lean: float = 0.0
    height: float = 0.045

    def __call__(self, points, side):
        z = np.maximum(points[:, 2], 0.0)
        moved = points.copy()
        moved[:, 0] -= self.push * (z / 0.08) ** 2 * np.exp(-(((z - self.height) / 0.05) ** 2))
        moved[:, 1] += (1.0 if side == "left" else -1.0) * self.lean * (z / 0.08) ** 2
        return moved


class FakeScene:
    """Jaws before a camera, a far background, and holders with the reference dots."""

    def __init__(self, view, bend=None):
        self.T_gripper_camera, self.origins = VIEWS[view]
        self.jaws = load_jaws(self.origins)
        self.bend = bend or Bend()
        self.views = {side: MeshView(self._body(side)) for side in self.jaws}

    def _body(self, side):
        jaw = self.jaws[side]
        mesh = jaw.build_mesh("coarse")
        nodes = self.bend(mesh.nodes, side)
        corners = np.array([[x, y, z] for x in (-0.02, 0.02) for y in (-0.01, 0.01) for z in (-0.02, 0.0)])
        quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        box = np.array([(q[i], q[j], q[k]) for q in quads for i, j, k in ((0, 1, 2), (0, 2, 3))])
        return ObjectMesh(
            vertices=np.vstack((nodes, corners)),
            triangles=np.vstack((mesh.surface, box + len(nodes))).astype(np.int32),
            watertight=False,
            name=side,
        )

    def poses(self, origins=None):
        origins = origins or self.origins
        return {side: jaw_in_camera(self.T_gripper_camera, side, origins[side]) for side in self.jaws}

    def keypoints(self, side):
        """(K + 1, 3) true places in the jaw frame, the reference point last."""
        jaw = self.jaws[side]
        return np.vstack((self.bend(jaw.keypoints, side), jaw.reference_point))

    def pixels(self, origins=None):
        """side -> (K + 1, 2) true pixels."""
        return {
            side: project(self.keypoints(side) @ T[:3, :3].T + T[:3, 3], CAMERA)
            for side, T in self.poses(origins).items()
        }

    def depth(self, origins=None):
        """True depths (h, w) of jaws and background."""
        depth = np.full((CAMERA.height, CAMERA.width), BACKGROUND)
        for side, T in self.poses(origins).items():
            depth = np.fmin(depth, self.views[side].render(T, CAMERA).depth)
        return depth

    def image(self, stamp, rng, origins=None, scale=0.0, noise=None, depth=None):
        """An image whose depth is disturbed and too large by `scale`."""
        depth = self.depth(origins) if depth is None else depth
        measured = disturb_depth(depth * (1.0 + scale), CAMERA, rng, noise or DepthNoise())
        return bare_image(stamp, measured, rng)


def bare_image(stamp, depth, rng=None):
    """An image with some grey colour."""
    color = np.full((CAMERA.height, CAMERA.width, 3), 90, dtype=np.uint8)
    return RgbdImage(stamp=stamp, color=color, depth=depth, camera=CAMERA)


class FakeFinder:
    """Returns given pixels with noise, and keeps what was expected of it."""

    def __init__(self, pixels, rng=None, stddev=0.4):
        self.pixels, self.rng, self.stddev = pixels, rng, stddev
        self.likelihood = {side: np.full(len(rows), 0.95) for side, rows in pixels.items()}
        self.expected = []

    def find(self, image, expected):
        self.expected.append(dict(expected))
        findings = {}
        for side, rows in self.pixels.items():
            noise = 0.0 if self.rng is None else self.stddev * self.rng.standard_normal(rows.shape)
            findings[side] = PixelFinding(
                pixels=rows + noise, likelihood=self.likelihood[side], stddev=np.full(len(rows), self.stddev)
            )
        return findings


@lru_cache(maxsize=16)
def scene_of(view, bend=None):
    """A scene and its true depths, drawn once."""
    scene = FakeScene(view, bend)
    return scene, scene.depth()


def build(view="robot", bend=None, rng=None, **settings):
    """A scene, its true depths, a finder that knows its pixels, and a detector around that."""
    scene, depth = scene_of(view, bend)
    finder = FakeFinder(scene.pixels(), rng)
    detector = KeypointDetector(finder, scene.jaws, scene.T_gripper_camera, DetectorSettings(**settings))
    return scene, depth, finder, detector
