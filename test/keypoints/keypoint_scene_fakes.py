"""Scenes, networks and pictures of jaws for tests of key points."""

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
import onnx
import yaml
from onnx import TensorProto, helper, numpy_helper

from finforce.camera import CameraIntrinsics, project
from finforce.gripper_frames import BENCH_CAMERA, BENCH_ORIGIN_X, ROBOT_CAMERA, jaw_in_camera
from finforce_contact.mesh.object_mesh import ObjectMesh
from finforce_contact.mesh.views import MeshView
from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints.detector import KeypointDetector
from finforce_keypoints.geometry.jaw_localizer import JawKeypoints
from finforce_keypoints.geometry.side_picture import find_side, intersect_plane
from finforce_keypoints.images import PixelDetection, RgbdImage
from finforce_keypoints.parameters import DetectorSettings
from finforce_sim.sensor import D405_DISTORTION, DepthNoise, disturb_depth

STRIDE = 8
LOCREF_STD = 7.2801
MEAN, STD = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
COLOURS = {
    "red": (255, 0, 0),
    "green": (0, 255, 0),
    "blue": (0, 0, 255),
    "yellow": (255, 255, 0),
    "magenta": (255, 0, 255),
    "cyan": (0, 255, 255),
}
_KINDS = {"float": TensorProto.FLOAT, "float16": TensorProto.FLOAT16, "uint8": TensorProto.UINT8}


@dataclass(frozen=True, kw_only=True)
class Fake:
    """A network: one heatmap per colour, 1 on squares of that colour and at most 0 on all others and on black."""

    names: tuple = ("red", "green", "blue", "yellow")
    colours: tuple = ("red", "green", "blue", "yellow")
    size: tuple = (None, None)  # frozen height and width
    batch: int | None = None
    nhwc: bool = False
    nhwc_outputs: bool = False
    kind: str = "float"
    outputs: str = "separate"  # or combined, heatmap, simcc, three
    output_names: tuple = ("heatmap", "locref")
    offset: tuple = (0.0, 0.0)  # px, of every locref
    logits: bool = False
    normalize: bool = True


def sidecar(fake, **changes):
    """DeepLabCut's configuration of a network; changes by dotted place with __ for the dot."""
    content = {
        "metadata": {"bodyparts": list(fake.names), "unique_bodyparts": [], "individuals": ["animal"]},
        "data": {"colormode": "RGB", "inference": {"normalize_images": fake.normalize}},
        "method": "bu",
        "net_type": "resnet_50",
        "model": {
            "backbone": {"type": "ResNet", "model_name": "resnet50_gn", "output_stride": 16},
            "heads": {
                "bodypart": {
                    "predictor": {
                        "type": "HeatmapPredictor",
                        "apply_sigmoid": fake.logits,
                        "clip_scores": True,
                        "location_refinement": fake.outputs != "heatmap",
                        "locref_std": LOCREF_STD,
                    },
                    "heatmap_config": {"channels": [2048, len(fake.names)], "kernel_size": [3], "strides": [2]},
                }
            },
        },
    }
    if fake.outputs != "heatmap":
        head = content["model"]["heads"]["bodypart"]
        head["locref_config"] = {"channels": [2048, 2 * len(fake.names)], "kernel_size": [3], "strides": [2]}
    for place, value in changes.items():
        *tables, key = place.split("__")
        table = content
        for name in tables:
            table = table.setdefault(name, {})
        table[key] = value
    return content


def write_model(folder, fake=None, **changes):
    """A folder with the network and its sidecar."""
    fake = fake or Fake()
    folder.mkdir(parents=True, exist_ok=True)
    onnx.save(build_network(fake), folder / "network.onnx")
    (folder / "pytorch_config.yaml").write_text(yaml.safe_dump(sidecar(fake, **changes)))
    return folder


def build_network(fake):
    """Pad -> AveragePool 8x8/8 -> 1x1 Conv -> Clip, and a Conv of zeros with a bias."""
    kind = _KINDS[fake.kind]
    inner = TensorProto.FLOAT if fake.kind == "uint8" else kind
    height, width = fake.size
    batch, parts = fake.batch or "batch", len(fake.colours)
    shape = [batch, height or "height", width or "width", 3] if fake.nhwc else [batch, 3, height or "h", width or "w"]
    nodes, constants, last = [], [], "input"
    if fake.kind == "uint8":
        nodes.append(helper.make_node("Cast", [last], ["cast"], to=TensorProto.FLOAT))
        last = "cast"
    if fake.nhwc:
        nodes.append(helper.make_node("Transpose", [last], ["planes"], perm=[0, 3, 1, 2]))
        last = "planes"
    dtype = np.float16 if fake.kind == "float16" else np.float32
    weights, bias = _colour_weights(fake)
    for name, array in {
        "pads": np.array([0, 0, 0, 0, 0, 0, _border(height), _border(width)], np.int64),
        "weights": weights.astype(dtype),
        "bias": bias.astype(dtype),
        "zeros": np.zeros((2 * parts, 3, 1, 1), dtype),
        "offsets": np.tile(np.divide(fake.offset, LOCREF_STD), parts).astype(dtype),
        "around": np.array(1e-6, dtype),  # not 0, for which onnxruntime fuses Pad and AveragePool and then refuses
        "low": np.array(0.0, dtype),
        "high": np.array(1.0, dtype),
    }.items():
        constants.append(numpy_helper.from_array(array, name))
    nodes += [
        helper.make_node("Pad", [last, "pads", "around"], ["padded"]),
        helper.make_node("AveragePool", ["padded"], ["pooled"], kernel_shape=[STRIDE] * 2, strides=[STRIDE] * 2),
        helper.make_node("Conv", ["pooled", "weights", "bias"], ["raw"]),
        helper.make_node("Identity", ["raw"], ["heat"])
        if fake.logits
        else helper.make_node("Clip", ["raw", "low", "high"], ["heat"]),
        helper.make_node("Conv", ["pooled", "zeros", "offsets"], ["shift"]),
    ]
    results = _finish(fake, nodes)
    graph = helper.make_graph(
        nodes,
        "squares",
        [helper.make_tensor_value_info("input", kind, shape)],
        [helper.make_tensor_value_info(name, inner, None) for name in results],
        constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 9
    return model


def _finish(fake, nodes):
    """The outputs' names, after the nodes that make them."""
    heat, shift = fake.output_names
    if fake.outputs == "combined":
        nodes.append(helper.make_node("Concat", ["heat", "shift"], [heat], axis=1))
        return [heat]
    if fake.outputs == "simcc":
        nodes.append(helper.make_node("ReduceMax", ["heat"], ["simcc_x"], axes=[2], keepdims=0))
        nodes.append(helper.make_node("ReduceMax", ["heat"], ["simcc_y"], axes=[3], keepdims=0))
        return ["simcc_x", "simcc_y"]
    made = [("heat", heat)] if fake.outputs == "heatmap" else [("heat", heat), ("shift", shift)]
    for source, name in made:
        if fake.nhwc_outputs:
            nodes.append(helper.make_node("Transpose", [source], [name], perm=[0, 2, 3, 1]))
        else:
            nodes.append(helper.make_node("Identity", [source], [name]))
    if fake.outputs == "three":
        nodes.append(helper.make_node("Identity", ["heat"], ["third"]))
        return [name for _, name in made] + ["third"]
    return [name for _, name in made]


def _border(size):
    """ResNet's map has 2 ceil(H / 16) + 1 cells; of a free size, a multiple of 16."""
    return STRIDE if size is None else STRIDE * (2 * -(-size // 16) + 1) - size


def _colour_weights(fake):
    """1x1 weights (K, 3, 1, 1) and biases (K,) that take back what the pre-processing does."""
    rgb = np.array([COLOURS[name] for name in fake.colours]) / 255.0
    # Of (1, 0, 0): r - g - b; of (1, 1, 0): r + g - 2 b - 1.
    count = rgb.sum(axis=1, keepdims=True)
    weights, bias = np.where(rgb > 0.5, 1.0, -count), 1.0 - count[:, 0]
    if fake.logits:
        weights, bias = 8.0 * weights, 8.0 * bias - 4.0
    if fake.kind == "uint8":
        return (weights / 255.0)[..., None, None], bias
    if fake.normalize:
        weights, bias = weights * STD, bias + weights @ MEAN
    return weights[..., None, None], bias


def paint(squares, size=(480, 640), half=6):
    """A black picture (h, w, 3) with squares {colour: (column, row) of the middle}."""
    picture = np.zeros((*size, 3), np.uint8)
    for colour, (x, y) in squares.items():
        x, y = round(x), round(y)
        picture[max(y - half, 0) : y + half, max(x - half, 0) : x + half] = COLOURS[colour]
    return picture


def small_jaws(sides=("left", "right")):
    """The bench jaw with two key points and its reference point."""
    left = load_jaw("bench")
    left = replace(left, keypoint_names=("inner_7", "tip"), keypoints=left.keypoints[[6, 14]])
    return {side: left if side == "left" else left.mirrored() for side in sides}


def bend(points, tip):
    """Points (n, 3) of a jaw whose tip moved by (x, z) [m], the base clamped."""
    s = np.clip(points[:, 2] / 0.080, 0.0, None) ** 2
    return points + s[:, None] * (tip[0], 0.0, tip[1])


def draw_dots(picture, points, T_camera_jaw, camera, color, diameter=0.003):
    """Draw discs on the side of a jaw, points (n, 3) [m], with the rim's pixels covered in part; returns (n, 2) px."""

    def see(places):
        return project(places @ T_camera_jaw[:3, :3].T + T_camera_jaw[:3, 3], camera)

    pixels = see(points)
    steps = [(see(points + step) - pixels) / 1e-4 for step in ((1e-4, 0.0, 0.0), (0.0, 0.0, 1e-4))]
    rows, columns = np.indices(picture.shape[:2])
    for k, (x, y) in enumerate(pixels):
        turn = np.linalg.inv(np.column_stack((steps[0][k], steps[1][k])))  # m per px
        part = slice(max(int(y) - 20, 0), int(y) + 22), slice(max(int(x) - 20, 0), int(x) + 22)
        offsets = np.stack((columns[part] - x, rows[part] - y), axis=-1) @ turn.T
        pitch = np.sqrt(abs(np.linalg.det(turn)))
        cover = np.clip(0.5 + (0.5 * diameter - np.hypot(*np.moveaxis(offsets, -1, 0))) / pitch, 0.0, 1.0)[..., None]
        picture[part] = np.round(picture[part] * (1.0 - cover) + cover * np.asarray(color)).astype(np.uint8)
    return pixels


NOISE = 4.0  # grey levels of each colour
SIDES = ("left", "right")


@lru_cache(maxsize=1)
def ground():
    """A texture with the contrast of a real finger, and how each pixel moves when its jaw moves along x by a metre."""
    rng = np.random.default_rng(5)
    texture = cv2.GaussianBlur(rng.standard_normal((CAMERA.height, CAMERA.width)), (0, 0), 2.0)
    texture = (120.0 + 40.0 * texture / texture.std()).astype(np.float32)
    scene, _ = scene_of("robot")
    columns, rows = np.meshgrid(np.arange(0, CAMERA.width, 4), np.arange(0, CAMERA.height, 4))
    pixels = np.column_stack((columns.ravel(), rows.ravel())).astype(float)
    fields = {}
    for side, T in scene.poses().items():
        plane = find_side(scene.jaws[side])
        places = intersect_plane(pixels, plane, T, CAMERA)
        z = places[:, 1]
        beside = [plane.points(places) + [step, 0.0, 0.0] for step in (0.0, 1e-4)]
        ends = [points @ T[:3, :3].T + T[:3, 3] for points in beside]
        way = (project(ends[1], CAMERA) - project(ends[0], CAMERA)) / 1e-4
        field = np.column_stack((way, np.clip(z, 0.0, 0.085))).reshape(*columns.shape, 3)
        fields[side] = cv2.resize(np.nan_to_num(field).astype(np.float32), (CAMERA.width, CAMERA.height))
    return texture, fields


@lru_cache(maxsize=1)
def noise_pool():
    """Noise of a sensor; any two ways of rolling it are independent."""
    return np.random.default_rng(0).normal(0.0, NOISE, (2 * CAMERA.height * CAMERA.width * 3,)).astype(np.float32)


def noise_of(seed):
    """The noise of one picture."""
    start = int(np.random.default_rng(seed).integers(CAMERA.height * CAMERA.width * 3))
    return noise_pool()[start:][: CAMERA.height * CAMERA.width * 3].reshape(CAMERA.height, CAMERA.width, 3)


def move_none(z):
    return 0.0 * z


def move_all(way):
    """The whole jaw by a way [m] along x."""
    return lambda z: way + 0.0 * z


def move_tip(way):
    """The tip by a way [m] along x, and what is below by the square of its height."""
    return lambda z: way * (z / 0.085) ** 2


def picture(seed, move=move_none, *, side="left", gain=1.0, offset=0.0):
    """A noisy picture of the jaws, one of which has moved."""
    texture, fields = ground()
    columns, rows = np.meshgrid(np.arange(CAMERA.width, dtype=np.float32), np.arange(CAMERA.height, dtype=np.float32))
    field = fields[side]
    mine = columns < CAMERA.width / 2 if side == "left" else columns >= CAMERA.width / 2
    way = np.where(mine, move(field[..., 2]), 0.0).astype(np.float32)
    moved = cv2.remap(texture, columns - way * field[..., 0], rows - way * field[..., 1], cv2.INTER_CUBIC)
    return np.clip(np.rint(gain * moved[..., None] + offset + noise_of(seed)), 0, 255).astype(np.uint8)


def found_at(stamp, rng=None, spread=1e-4, hidden=0):
    """Key points of both jaws at rest with an error that is another one in every image; some are hidden."""
    scene, _ = scene_of("robot")
    found = {}
    for side, T in scene.poses().items():
        points = scene.keypoints(side)[:-1]
        valid = np.arange(len(points)) >= hidden
        error = 0.0 if rng is None else rng.normal(0.0, spread, points.shape)
        found[side] = JawKeypoints(
            stamp=stamp,
            points=points + error,
            likelihood=np.where(valid, 0.9, 0.0),
            pixels=project(points @ T[:3, :3].T + T[:3, 3], CAMERA),
            valid=valid,
            stddev=np.full(points.shape, 2e-4),
            T_camera_jaw=T.copy(),
            reasons=np.where(valid, "", "likelihood"),
        )
    return found


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


class FakePixelDetector:
    """Returns given pixels with noise, and keeps what was expected of it."""

    def __init__(self, pixels, rng=None, stddev=0.4):
        self.pixels, self.rng, self.stddev = pixels, rng, stddev
        self.likelihood = {side: np.full(len(rows), 0.95) for side, rows in pixels.items()}
        self.expected = []

    def detect(self, image, expected):
        self.expected.append(dict(expected))
        detections = {}
        for side, rows in self.pixels.items():
            noise = 0.0 if self.rng is None else self.stddev * self.rng.standard_normal(rows.shape)
            detections[side] = PixelDetection(
                pixels=rows + noise, likelihood=self.likelihood[side], stddev=np.full(len(rows), self.stddev)
            )
        return detections


@lru_cache(maxsize=16)
def scene_of(view, bend=None):
    """A scene and its true depths, drawn once."""
    scene = FakeScene(view, bend)
    return scene, scene.depth()


def build(view="robot", bend=None, rng=None, **settings):
    """A scene, its true depths, a pixel_detector that knows its pixels, and a detector around that."""
    scene, depth = scene_of(view, bend)
    pixel_detector = FakePixelDetector(scene.pixels(), rng)
    detector = KeypointDetector(pixel_detector, scene.jaws, scene.T_gripper_camera, DetectorSettings(**settings))
    return scene, depth, pixel_detector, detector


def lost_sides(detector):
    """The jaws that a detector has to look for everywhere."""
    return tuple(side for side, jaw in detector._jaws.items() if jaw.is_lost)
