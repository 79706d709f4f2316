"""Networks of four operators that find coloured squares and keep DeepLabCut's contract; pictures of squares, dots."""

from dataclasses import dataclass, replace

import numpy as np
import onnx
import yaml
from onnx import TensorProto, helper, numpy_helper

from finforce.camera import project
from finforce_ifea.jaw.jaw import load_jaw

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
