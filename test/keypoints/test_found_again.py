"""Jaws of the twin, found by networks with DeepLabCut's files and outputs, lost for 47 images, and found again."""

import numpy as np
import onnx
import pytest
import yaml
from keypoint_scene_fakes import Fake, lost_sides, sidecar
from onnx import TensorProto, helper, numpy_helper

from finforce.camera import project
from finforce_keypoints.build import build_detector
from finforce_keypoints.images import RgbdImage
from finforce_keypoints.parameters import DetectorParameters
from finforce_sim.gripper import TwinGripper
from finforce_sim.scenarios import build_scenario
from finforce_sim.sensor import build_d405_vga
from finforce_sim.simulated_camera import SimulatedCamera

CAMERA, STRIDE, SIDE = build_d405_vga(), 2, 17  # input pixels per cell; px, of the patches a network knows
GREY = np.array([0.299, 0.587, 0.114], np.float32)[None, :, None, None]


@pytest.fixture(scope="module")
def scene():
    """The gripper, who takes its pictures, what a perfect sensor sees of the jaws at rest, and their true pixels."""
    gripper = TwinGripper(build_scenario("grasp_cylinder"), 3, density="coarse")
    simulated_camera = SimulatedCamera(gripper, CAMERA, 3)
    simulated_camera.mesh = None
    view = simulated_camera.look(next(iter(gripper.states())))
    pixels = {}
    for side, true in view.jaws.items():
        points = np.vstack((true.points, gripper.jaws[side].reference_point))
        pixels[side] = project(points @ true.T_camera_jaw[:3, :3].T + true.T_camera_jaw[:3, 3], CAMERA)
    return gripper, simulated_camera, view, pixels


def correlate(patches, sees_whole):
    """A network whose maps are correlations with grey patches (K, SIDE, SIDE), of the brightness around taken off."""
    kernels = patches - patches.mean(axis=(1, 2), keepdims=True)
    kernels /= np.linalg.norm(kernels, axis=(1, 2), keepdims=True)
    edge = SIDE // 2
    constants = {
        "grey": GREY,
        "kernels": kernels[:, None].astype(np.float32),
        "mean": np.full((1, 1, SIDE, SIDE), SIDE**-2, np.float32),
        "count": np.array(SIDE**2, np.float32),
        "least": np.array(SIDE**2 * 0.02**2, np.float32),
        "most": np.array(1e9, np.float32),
        "low": np.array(0.0, np.float32),
        "high": np.array(1.0, np.float32),
        "none": np.zeros((2 * len(patches), 1, 1, 1), np.float32),
        "half": np.tile(np.array([-0.5, -0.5], np.float32) / 7.2801, len(patches)),
        "one": np.ones(3, np.float32),
        "zero": np.zeros(3, np.float32),
    }
    window = {"strides": [STRIDE] * 2, "pads": [edge] * 4}
    make = helper.make_node
    nodes = [
        make("Conv", ["input", "grey"], ["picture"]),
        make("Mul", ["picture", "picture"], ["squared"]),
        make("Conv", ["picture", "kernels"], ["likeness"], **window),
        make("Conv", ["picture", "mean"], ["means"], **window),
        make("Conv", ["squared", "mean"], ["squares"], **window),
        make("Mul", ["means", "means"], ["of_mean"]),
        make("Sub", ["squares", "of_mean"], ["variance"]),
        make("Mul", ["variance", "count"], ["energy"]),
        make("Clip", ["energy", "least", "most"], ["bounded"]),
        make("Sqrt", ["bounded"], ["contrast"]),
        make("Div", ["likeness", "contrast"], ["score"]),
        make("Clip", ["score", "low", "high"], ["heatmap"]),
        make("Conv", ["means", "none", "half"], ["locref"]),
    ]
    if sees_whole:
        nodes.append(make("InstanceNormalization", ["input", "one", "zero"], ["normal"]))
    inputs = [helper.make_tensor_value_info("input", TensorProto.FLOAT, ["batch", 3, "height", "width"])]
    outputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in ("heatmap", "locref")]
    weights = [numpy_helper.from_array(array, name) for name, array in constants.items()]
    graph = helper.make_graph(nodes, "patches", inputs, outputs, weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 9
    return model


def learn(scene, folder, sees_whole):
    """A folder as DeepLabCut's export writes it, of a network that knows the picture around every point."""
    gripper, simulated_camera, view, pixels = scene
    names = [f"{side}_{name}" for side in pixels for name in (*gripper.jaws[side].keypoint_names, "reference")]
    grey = simulated_camera.develop(view, 0.0).color @ GREY.ravel() / 255.0
    half = SIDE // 2
    patches = []
    for x, y in np.round(np.vstack(list(pixels.values())) / STRIDE).astype(int) * STRIDE:
        framed = np.pad(grey, half)
        patches.append(framed[y : y + SIDE, x : x + SIDE])
    onnx.save(correlate(np.array(patches), sees_whole), folder / "network.onnx")
    fake = Fake(names=tuple(names), colours=tuple(names), normalize=False)
    content = sidecar(fake, model__backbone__output_stride=2 * STRIDE)
    (folder / "pytorch_config.yaml").write_text(yaml.safe_dump(content))
    return folder


def picture(scene, number, has_jaws):
    """The image of a number, at 30 Hz: of the jaws, or of a grey wall in their place."""
    _, simulated_camera, view, _ = scene
    stamp = number / 30.0
    shot = simulated_camera.develop(view, stamp)
    color, depth = shot.color, shot.depth
    if not has_jaws:
        noise = np.random.default_rng(number).normal(0.0, 2.0, color.shape)
        color, depth = np.clip(110.0 + noise, 0, 255).astype(np.uint8), np.full_like(depth, 0.4)
    return RgbdImage(stamp=stamp, color=color, depth=depth, camera=CAMERA)


@pytest.mark.parametrize("sees_whole", [False, True])
def test_jaws_that_were_lost_for_a_second_and_a_half_are_found_again(scene, tmp_path, sees_whole):
    gripper, _, _, pixels = scene
    model = str(learn(scene, tmp_path, sees_whole))
    detector = build_detector(gripper.jaws, DetectorParameters(detection_method="frame", model=model, threads=1))
    for number in range(62):  # searched for in 30 of them, then every 0.3 s
        has_jaws = not 3 <= number < 50
        found = detector.detect(picture(scene, number, has_jaws))
        assert has_jaws or not any(keypoints.valid.any() for keypoints in found.values())
        assert number != 49 or set(lost_sides(detector)) == {"left", "right"}
    for side, true in pixels.items():
        error = np.linalg.norm(found[side].pixels - true[:-1], axis=1)
        assert found[side].valid.all() and error.max() < STRIDE  # px
