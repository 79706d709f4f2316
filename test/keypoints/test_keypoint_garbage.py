"""Claims about rubbish: odd networks and configurations are named at the start, pictures of nothing have no points."""

from dataclasses import replace

import numpy as np
import onnx
import pytest
import yaml
from keypoint_scene_fakes import CAMERA, Fake, FakePixelDetector, FakeScene, bare_image, sidecar, write_model
from onnx import TensorProto, helper, numpy_helper

from finforce.typed_yaml import parse_model
from finforce_keypoints.detector import KeypointDetector
from finforce_keypoints.errors import FrozenImageError, ModelError
from finforce_keypoints.images import ImageWatch
from finforce_keypoints.networks.metadata import ModelMetadata, read_metadata
from finforce_keypoints.networks.model import DecodingRule, KeypointModel, decode

SIZE = (256, 256)
PICTURE = np.full((1, *SIZE, 3), 128, np.uint8)


def write_constant(folder, *outputs, kind=TensorProto.FLOAT, operator="Identity", shape=("b", 3, "h", "w"), **changes):
    """A folder with a network that says the same of every picture."""
    folder.mkdir(parents=True, exist_ok=True)
    names = ("heatmap", "locref")[: len(outputs)]
    constants = [
        numpy_helper.from_array(np.asarray(array), f"c_{name}") for name, array in zip(names, outputs, strict=True)
    ]
    nodes = [helper.make_node(operator, [f"c_{name}"], [name]) for name in names]
    make = helper.make_tensor_sequence_value_info if operator == "SequenceConstruct" else helper.make_tensor_value_info
    graph = helper.make_graph(
        nodes,
        "constant",
        [helper.make_tensor_value_info("input", TensorProto.FLOAT, shape)],
        [make(name, kind, None) for name in names],
        constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 9
    onnx.save(model, folder / "network.onnx")
    content = sidecar(Fake(outputs="separate" if len(outputs) == 2 else "heatmap"), **changes)
    (folder / "pytorch_config.yaml").write_text(yaml.safe_dump(content))
    return folder


def maps(value, shape=(1, 4, 32, 32), kind=np.float32):
    return np.full(shape, value, kind)


@pytest.mark.parametrize(
    ("outputs", "options"),
    [
        ([maps(0.0, (1, 4, 0, 32))], {}),
        ([maps(0.0, (2, 4, 32, 32))], {}),
        ([maps(0.0), maps(0.0, (1, 8, 16, 16))], {}),
        ([maps("a", kind=object)], {"kind": TensorProto.STRING}),
        ([maps(0.0)], {"operator": "SequenceConstruct"}),
        ([maps(0.0)], {"shape": [1, 3, 200_000, 200_000]}),
    ],
)
def test_a_network_that_makes_no_maps_of_one_picture_is_refused_at_the_start(tmp_path, outputs, options):
    with pytest.raises(ModelError, match="expected") as caught:
        KeypointModel(write_constant(tmp_path, *outputs, **options), threads=1)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", [0.0, 1.0, 1e30, np.nan, np.inf, -np.inf])
def test_a_map_that_is_the_same_everywhere_has_no_peak(tmp_path, value):
    with np.errstate(all="raise"):
        peaks = KeypointModel(write_constant(tmp_path, maps(value)), threads=1).locate(PICTURE)
    assert (peaks.likelihood == 0.0).all()


def test_a_peak_on_a_high_ground_is_none_and_one_on_a_low_ground_is():
    heat = np.zeros((1, 1, 30, 30), np.float32)
    heat[0, 0, 12, 7] = 0.9
    rule = DecodingRule(stride=8.0)
    assert decode(heat, None, rule, (240, 240)).likelihood == pytest.approx(0.9)
    assert decode(np.maximum(heat, 0.5), None, rule, (240, 240)).likelihood == 0.0
    # a sigmoid of what is one already lifts the ground to a half
    assert decode(heat, None, replace(rule, apply_sigmoid=True), (240, 240)).likelihood == 0.0


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
def test_offsets_that_are_no_numbers_give_no_place_and_no_warning(tmp_path, value):
    heat = maps(0.0)
    heat[:, :, 9, 9] = 1.0
    with np.errstate(all="raise"):
        peaks = KeypointModel(write_constant(tmp_path, heat, maps(value, (1, 8, 32, 32))), threads=1).locate(PICTURE)
    assert (peaks.likelihood == 0.0).all() and np.isnan(peaks.pixels).all()


PLACES = {
    "stride": "model__backbone__output_stride",
    "locref": "model__heads__bodypart__predictor__locref_std",
    "padding": "data__inference__auto_padding",
    "own": "finforce",
    "names": "metadata__bodyparts",
}


@pytest.mark.parametrize(
    ("place", "value"),
    [
        *((place, number) for place in ("stride", "locref") for number in (10**400, float("nan"), float("inf"), True)),
        *(("padding", {"pad_height_divisor": size}) for size in (1_000_000, 10**23, 0, -32)),
        *(("own", {"training_size": {"height": size, "width": size}}) for size in (100_000, 10**26, True, 1.5)),
        *(("own", {"likelihood_stddev": rows}) for rows in ([[0.5, 10**400]], [["a", "b"]], 5)),
        *(("own", {"pooled": word}) for word in ("maybe", [0])),
        *(("names", [name, "b", "c", "d"]) for name in ("", "  ", "a\nb", "a\tb")),
    ],
)
def test_numbers_and_names_that_cannot_be_are_refused_at_the_start(tmp_path, place, value):
    with pytest.raises(ModelError, match="got|expected") as caught:
        KeypointModel(write_model(tmp_path, **{PLACES[place]: value}), threads=1)
    assert len(str(caught.value)) < 600 and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    ["metadata:\n\tbodyparts: [a]", "a: " + "[" * 20_000 + "]" * 20_000, "a: 1" + "0" * 5_000, "a: !!python/none x\0"],
)
def test_a_configuration_that_is_no_yaml_is_refused_in_one_line(tmp_path, text):
    path = tmp_path / "pytorch_config.yaml"
    path.write_text(text)
    with pytest.raises(ModelError, match="cannot be read") as caught:
        read_metadata(path)
    assert "\n" not in str(caught.value)


def test_a_configuration_that_repeats_itself_is_refused_briefly():
    names = ["x"]
    for _ in range(12):
        names = [names] * 9
    with pytest.raises(ModelError, match="bodyparts") as caught:
        parse_model({"metadata": {"bodyparts": names}}, ModelMetadata, ModelError)
    assert len(str(caught.value)) < 600


def test_a_path_that_cannot_be_is_refused():
    with pytest.raises(ModelError, match="cannot be looked for"):
        KeypointModel("x" * 5_000)


def noisy(rng, shape=(480, 640, 3)):
    return rng.integers(60, 120, shape, dtype=np.uint8)


def watch_pictures(change):
    """Look at six pictures of a scene at rest, each of whose colours and depths were changed by a function."""
    rng, watch = np.random.default_rng(0), ImageWatch(frozen_after=3)
    still = noisy(rng), rng.uniform(0.1, 0.2, (480, 640)).astype(np.float32)
    for _ in range(6):
        color, depth = change(noisy(rng), rng.uniform(0.1, 0.2, (480, 640)).astype(np.float32), *still)
        watch.check(replace(bare_image(0.0, depth), color=color))


def test_a_part_of_the_picture_that_stands_still_is_noticed():
    def freeze(color, depth, still, _):
        color[:, :320] = still[:, :320]
        return color, depth

    with pytest.raises(FrozenImageError, match="8 of 16 parts"):
        watch_pictures(freeze)


@pytest.mark.parametrize("level", [0, 255])
def test_a_part_that_is_black_or_white_may_stand_still(level):
    def saturate(color, depth, *_):
        color[:, :320] = level
        return color, depth

    watch_pictures(saturate)


def test_depth_that_stands_still_is_noticed_and_depth_that_is_nowhere_is_not_called_so():
    with pytest.raises(FrozenImageError, match="depth images"):
        watch_pictures(lambda color, depth, _, still: (color, still))
    watch_pictures(lambda color, depth, *_: (color, np.full_like(depth, np.nan)))


def detect_pixels(change):
    """What a detector says of a bent jaw whose pixels (K + 1, 2) and likelihood (K + 1,) were changed."""
    scene = FakeScene("robot")
    pixel_detector = FakePixelDetector(scene.pixels())
    for side in scene.jaws:
        pixel_detector.pixels[side], pixel_detector.likelihood[side] = change(
            pixel_detector.pixels[side].copy(), pixel_detector.likelihood[side]
        )
    detector = KeypointDetector(pixel_detector, scene.jaws, scene.T_gripper_camera)
    return detector.detect(scene.image(0.0, np.random.default_rng(0)))


def test_a_few_likely_points_are_no_jaw_and_more_of_them_are():
    def keep(count):
        return lambda pixels, likelihood: (pixels, np.where(np.arange(16)[::-1] < count, likelihood, 0.1))

    assert not detect_pixels(keep(5))
    assert set(detect_pixels(keep(6))) == {"left", "right"}


def test_a_reference_point_that_the_points_near_it_contradict_is_no_jaw():
    def scatter(pixels, likelihood):
        pixels[:-1] += np.random.default_rng(1).uniform(-80.0, 80.0, (len(pixels) - 1, 2))
        return pixels.clip(0.0, (CAMERA.width - 1, CAMERA.height - 1)), likelihood

    assert not detect_pixels(scatter)
    assert set(detect_pixels(lambda *detection: detection)) == {"left", "right"}
