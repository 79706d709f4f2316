"""Networks and their metadata: what is understood, and what is refused."""

import os
import subprocess
import sys

import numpy as np
import onnx
import pytest
import yaml
from keypoint_scene_fakes import Fake, paint, sidecar, write_model

from finforce.errors import MissingDependencyError
from finforce.typed_yaml import parse_model
from finforce_keypoints.build import BENCH
from finforce_keypoints.errors import DetectionError, ModelError
from finforce_keypoints.networks.metadata import ModelMetadata
from finforce_keypoints.networks.model import KeypointModel, decode, find_input

# The squares of 12 px lie on the middles of cells: one cell is pure, its neighbours hold a quarter.
SQUARES = {"red": (100, 68), "green": (340, 204), "blue": (628, 12), "yellow": (20, 460)}
PLACES = np.array(list(SQUARES.values()), float)
HALF_CELL = 4.01  # px: without offsets a square is found to half a stride
FAKES = {
    "nchw": Fake(),
    "nhwc": Fake(nhwc=True),
    "nhwc all through": Fake(nhwc=True, nhwc_outputs=True),
    "combined": Fake(outputs="combined"),
    "no locref": Fake(outputs="heatmap"),
    "fp16": Fake(kind="float16"),
    "uint8": Fake(kind="uint8"),
    "frozen": Fake(size=(480, 640)),
    "frozen batch": Fake(batch=1),
    "frozen batch of four": Fake(batch=4),
    "other names": Fake(output_names=("a", "b")),
    "score and offset": Fake(output_names=("part_pred", "offset_maps")),
    "logits": Fake(logits=True),
    "not normalised": Fake(normalize=False),
}


@pytest.mark.parametrize("name", FAKES)
def test_coloured_squares_are_found_by_every_kind_of_export(tmp_path, name):
    model = KeypointModel(write_model(tmp_path, FAKES[name]), threads=1)
    batch = np.stack((paint(SQUARES), paint({"green": (100, 68)})))
    peaks = model.locate(batch)
    assert np.abs(peaks.pixels[0] - PLACES).max() <= HALF_CELL
    assert peaks.likelihood[0].min() > 0.95  # exactly 1 but for float16 and the sigmoid
    assert np.abs(peaks.pixels[1, 1] - (100, 68)).max() <= HALF_CELL
    assert peaks.likelihood[1, [0, 2, 3]].max() < 0.05


@pytest.mark.parametrize("threads", [1, 2])
def test_many_pictures_come_out_as_each_alone(tmp_path, threads):
    model = KeypointModel(write_model(tmp_path), threads=threads)
    pictures = np.stack([paint({"green": (100 + 40 * number, 68)}) for number in range(5)])
    alone = np.concatenate([model.locate(picture[None]).pixels for picture in pictures])[:, 1]
    assert np.abs(model.locate(pictures).pixels[:, 1] - alone).max() < 1e-3


def test_maps_have_the_shapes_of_a_resnet(tmp_path):
    model = KeypointModel(write_model(tmp_path), threads=1)
    heatmap, locref = model.run(paint(SQUARES)[None])
    assert heatmap.shape == (1, 4, 61, 81) and locref.shape == (1, 8, 61, 81)
    assert heatmap.dtype == locref.dtype == np.float32


def test_a_constant_offset_moves_every_place(tmp_path):
    still = KeypointModel(write_model(tmp_path / "a"), threads=1).locate(paint(SQUARES)[None])
    model = KeypointModel(write_model(tmp_path / "b", Fake(offset=(3.0, -2.0))), threads=1)
    moved = model.locate(paint(SQUARES)[None])
    shift = (moved.pixels - still.pixels)[0, :3]
    assert np.abs(shift - (3.0, -2.0)).max() < 1e-4  # float32


def test_input_is_normalised_as_the_metadata_say(tmp_path):
    model = KeypointModel(write_model(tmp_path), threads=1)
    batch = np.zeros((1, 32, 32, 3), np.uint8)
    batch[0, 3, 5] = (255, 128, 10)
    expected = (np.array([255, 128, 10]) / 255.0 - (0.485, 0.456, 0.406)) / (0.229, 0.224, 0.225)
    assert np.abs(model.preprocess(batch)[0, :, 3, 5] - expected).max() < 1e-5  # float32
    plain = KeypointModel(write_model(tmp_path, data__inference__normalize_images=False), threads=1)
    assert np.abs(plain.preprocess(batch)[0, :, 3, 5] - np.array([1.0, 128 / 255, 10 / 255])).max() < 1e-6


def test_a_network_without_normalisation_given_the_trained_one_loses_its_likelihood(tmp_path):
    model = KeypointModel(write_model(tmp_path, data__inference__normalize_images=False), threads=1)
    assert model.locate(paint(SQUARES)[None]).likelihood.min() < 0.6


def test_colours_are_turned_for_a_network_of_bgr(tmp_path):
    model = KeypointModel(write_model(tmp_path, data__colormode="BGR"), threads=1)
    peaks = model.locate(paint({"blue": (100, 68)})[None])
    assert np.abs(peaks.pixels[0, 0] - (100, 68)).max() <= HALF_CELL and peaks.likelihood[0, 2] < 1e-3


def test_pictures_are_padded_to_the_divisor_and_nothing_is_found_in_the_padding(tmp_path):
    padding = {"pad_height_divisor": 32, "pad_width_divisor": 32}
    model = KeypointModel(write_model(tmp_path, data__inference__auto_padding=padding), threads=1)
    picture = paint({"red": (300, 184)}, size=(198, 310))  # across two cells; its reflection fills one
    assert model.preprocess(picture[None]).shape == (1, 3, 224, 320)
    peaks = model.locate(picture[None])
    assert np.abs(peaks.pixels[0, 0] - (300, 184)).max() <= HALF_CELL
    maps = model.run(picture[None])
    everywhere = decode(*maps, model.find_rule((224, 320), maps[0].shape[2:]), (224, 320))
    assert everywhere.pixels[0, 0, 1] > 198 and everywhere.likelihood[0, 0] > peaks.likelihood[0, 0] + 0.1


def test_a_frozen_network_takes_the_size_that_is_padded_to_its_own(tmp_path):
    padding = {"pad_height_divisor": 32, "pad_width_divisor": 32}
    fake = Fake(size=(224, 320))
    model = KeypointModel(write_model(tmp_path, fake, data__inference__auto_padding=padding), threads=1)
    assert model.accepts((200, 310)) and not model.accepts((190, 310))
    assert model.locate(paint({"red": (100, 68)}, (200, 310))[None]).likelihood[0, 0] > 0.999


@pytest.mark.parametrize(
    ("fake", "changes", "message"),
    [
        (Fake(names=("red", "green", "blue")), {}, "3 heatmaps and 6 offsets"),
        (Fake(outputs="heatmap", names=("red", "green", "blue")), {}, "expected 3 channels, or 9 with offsets"),
        (Fake(outputs="simcc"), {}, "SimCC"),
        (Fake(outputs="three", output_names=("a", "b")), {}, "outputs"),
        (Fake(outputs="heatmap"), {"model__heads__bodypart__locref_config": {}, **{}}, None),
        (Fake(), {"model__backbone__output_stride": 32}, "stride 16"),
        (Fake(), {"model__heads__bodypart__predictor__type": "DEKRPredictor"}, "DEKRPredictor"),
        (Fake(), {"metadata__individuals": ["a", "b"]}, "individuals"),
        (Fake(), {"metadata__bodyparts": []}, "bodyparts"),
        (Fake(), {"metadata__bodyparts": ["a", "a", "b", "c"]}, "more than once"),
        (Fake(), {"data__colormode": "HSV"}, "colormode"),
        (Fake(), {"method": "td"}, "whole images"),
        (Fake(), {"data__inference__resize": {"height": 240, "width": 320}}, "not scaled"),
        (Fake(), {"data__inference__resize": False, "data__inference__scale_to_unit_range": False}, None),
        (Fake(), {"data__inference__longest_max_size": 320}, "not scaled"),
        (Fake(), {"data__inference__scale_to_unit_range": True}, "both True"),
        (Fake(normalize=False), {"data__inference__scale_to_unit_range": True}, None),
        (Fake(normalize=False), {"data__inference__scale_to_unit_range": False}, "both False"),
        (Fake(), {"data__inference__normalize_images": "yes"}, "normalize_images"),
        (Fake(), {"model__heads__bodypart__predictor__locref_std": -1.0}, "locref_std"),
        (Fake(), {"data__inference__auto_padding": {"pad_height_divisor": 0}}, "auto_padding"),
        (Fake(), {"finforce__likelihood_stddev": [[0.5, 2.0], [0.4, 3.0]]}, "likelihood_stddev"),
        (Fake(), {"finforce__likelihood_stddev": [["much", 2.0]]}, "likelihood_stddev"),
        (Fake(), {"finforce__training_size": [480, 640]}, "training_size"),
        (Fake(size=(480, 640)), {"finforce__training_size": {"height": 240, "width": 320}}, "frozen"),
    ],
)
def test_wrong_networks_and_metadata_are_refused_at_the_start(tmp_path, fake, changes, message):
    write_model(tmp_path, fake, **changes)
    if message is None:
        KeypointModel(tmp_path, threads=1)  # offsets that the predictor does not want may be missing
        return
    with pytest.raises(ModelError, match=message):
        KeypointModel(tmp_path, threads=1)


def test_offsets_that_the_metadata_promise_must_be_there(tmp_path):
    changes = {
        "model__heads__bodypart__locref_config": {"channels": [8]},
        "model__heads__bodypart__predictor__location_refinement": True,
    }
    with pytest.raises(ModelError, match="locref_config"):
        KeypointModel(write_model(tmp_path, Fake(outputs="heatmap"), **changes), threads=1)


def test_offsets_are_left_alone_where_the_metadata_say_so(tmp_path):
    changes = {"model__heads__bodypart__predictor__location_refinement": False}
    model = KeypointModel(write_model(tmp_path, Fake(offset=(3.0, 3.0)), **changes), threads=1)
    assert model.run(paint(SQUARES)[None])[1] is None


@pytest.mark.parametrize(("name", "kind"), [("snapshot-50000.pb", "TensorFlow"), ("snapshot-050.pt", "PyTorch")])
def test_networks_of_other_programs_are_told_how_to_become_one(name, kind, tmp_path):
    (tmp_path / name).write_bytes(b"x")
    for path in (tmp_path, tmp_path / name):
        with pytest.raises(ModelError, match=f"{name}: a {kind} file; expected an ONNX .*export_deeplabcut.py") as told:
            KeypointModel(path)
        assert ("DeepLabCut 3" in str(told.value)) == (kind == "TensorFlow")


def test_files_that_are_missing_or_doubled_or_broken_are_named(tmp_path):
    with pytest.raises(ModelError, match="found none"):
        KeypointModel(tmp_path)
    write_model(tmp_path)
    (tmp_path / "other.onnx").write_bytes(b"x")
    with pytest.raises(ModelError, match=r"network.onnx, other.onnx"):
        KeypointModel(tmp_path)
    with pytest.raises(ModelError, match="other.onnx: made its reader fail.*expected an ONNX network"):
        KeypointModel(tmp_path / "other.onnx")
    newer = onnx.load(tmp_path / "network.onnx")
    newer.ir_version = 99
    onnx.save(newer, tmp_path / "other.onnx")
    with pytest.raises(
        ModelError, match=r"IR version: 99, max supported.*expected an ONNX network that onnxruntime 1\."
    ):
        KeypointModel(tmp_path / "other.onnx")
    (tmp_path / "pytorch_config.yaml").unlink()
    with pytest.raises(ModelError, match="body parts"):
        KeypointModel(tmp_path / "network.onnx")
    (tmp_path / "pytorch_config.yaml").write_text("metadata: [")
    with pytest.raises(ModelError, match="cannot be read"):
        KeypointModel(tmp_path / "network.onnx")


def test_an_input_that_is_no_colour_image_is_refused(tmp_path):
    model = onnx.load(write_model(tmp_path) / "network.onnx")
    model.graph.input[0].type.tensor_type.shape.dim[1].dim_value = 1
    onnx.save(model, tmp_path / "network.onnx")
    with pytest.raises(ModelError, match="network|input"):
        KeypointModel(tmp_path)


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        ([("a", [1, 3, 8, 8], "tensor(float)"), ("b", [1], "tensor(float)")], "exactly one"),
        ([("a", [1, 4, 8, 8], "tensor(float)")], "expected .batch, 3"),
        ([("a", [1, 3, 8], "tensor(float)")], "expected .batch, 3"),
        ([("a", [1, 3, 8, 8], "tensor(double)")], "double"),
    ],
)
def test_inputs_other_than_one_image_are_refused(inputs, message):
    with pytest.raises(ModelError, match=message):
        find_input(inputs)


def test_pictures_that_the_network_cannot_take_are_refused(tmp_path):
    model = KeypointModel(write_model(tmp_path, Fake(size=(480, 640))), threads=1)
    with pytest.raises(DetectionError, match="frozen"):
        model.locate(np.zeros((1, 240, 320, 3), np.uint8))
    for wrong in (np.zeros((480, 640, 3), np.uint8), np.zeros((1, 480, 640, 3)), np.zeros((1, 480, 640, 4), np.uint8)):
        with pytest.raises(DetectionError, match="uint8 RGB"):
            model.run(wrong)


def test_the_metadata_say_how_maps_are_decoded(tmp_path):
    head = "model__heads__bodypart__predictor"
    changes = {"model__backbone__output_stride": 16, f"{head}__locref_std": 2 * 7.2801}
    model = KeypointModel(write_model(tmp_path, Fake(offset=(3.64005, 0.0)), **changes), threads=1)
    rule = model.find_rule((480, 640), (61, 81))
    assert rule.stride == 8.0 and rule.locref_std == 2 * 7.2801
    places = model.locate(paint(SQUARES)[None]).pixels
    assert np.abs(places[0, :2, 0] - PLACES[:2, 0] - 7.2801).max() <= HALF_CELL
    logits = KeypointModel(write_model(tmp_path / "logits", **{f"{head}__apply_sigmoid": True}), threads=1)
    assert logits.find_rule((480, 640), (61, 81)).apply_sigmoid
    with pytest.raises(ModelError, match="stride 2"):
        KeypointModel(write_model(tmp_path / "fine", model__backbone__output_stride=4))


def test_the_training_size_comes_from_network_or_metadata(tmp_path):
    kept = {"finforce__training_size": {"height": 480, "width": 640}}
    write_model(tmp_path / "kept", **kept)
    kept = KeypointModel(tmp_path / "kept")
    assert kept.training_size == (480, 640) and kept.accepts((480, 640)) and not kept.accepts((240, 320))
    assert KeypointModel(write_model(tmp_path / "frozen", Fake(size=(96, 64)))).training_size == (96, 64)
    assert KeypointModel(write_model(tmp_path / "free")).training_size is None


def test_without_onnxruntime_the_message_says_what_to_install(tmp_path, monkeypatch):
    write_model(tmp_path)

    def refuse(name):
        raise ImportError(f"no {name}")

    monkeypatch.setattr("finforce.optional.import_module", refuse)
    with pytest.raises(MissingDependencyError, match="pip install onnxruntime"):
        KeypointModel(tmp_path)


RUN_A_NETWORK = """
import sys
from finforce.optional import import_onnxruntime
import_onnxruntime().InferenceSession(sys.argv[1])
"""


def test_a_network_runs_without_a_record_of_its_uses(tmp_path):
    write_model(tmp_path / "model")
    (home := tmp_path / "home").mkdir()
    kept = {
        name: value for name, value in os.environ.items() if name not in ("ORT_DISABLE_TELEMETRY", "XDG_CACHE_HOME")
    }
    environment = kept | {"HOME": str(home), "TMPDIR": str(home), "NUMBA_CACHE_DIR": str(tmp_path / "numba")}
    order = [sys.executable, "-c", RUN_A_NETWORK, str(tmp_path / "model" / "network.onnx")]
    subprocess.run(order, env=environment, check=True, timeout=120)
    assert not list(home.iterdir())


def test_defaults_of_absent_keys_are_those_of_deeplabcut():
    metadata = parse_model({"metadata": {"bodyparts": ["a"]}}, ModelMetadata, ModelError)
    assert metadata.normalize_images and metadata.location_refinement
    assert not metadata.apply_sigmoid
    assert metadata.locref_std == 7.2801 and metadata.stride is None and metadata.divisors == (1, 1)
    with pytest.raises(ModelError, match="data: got a list .*, expected a mapping"):
        parse_model({"metadata": {"bodyparts": ["a"]}, "data": [1]}, ModelMetadata, ModelError)
    with pytest.raises(ModelError, match="got none, expected a mapping of data, metadata"):
        parse_model([], ModelMetadata, ModelError)


def test_metadata_are_those_that_deeplabcut_writes():
    metadata = parse_model(yaml.safe_load(yaml.safe_dump(sidecar(Fake()))), ModelMetadata, ModelError)
    assert metadata.stride == 8.0 and metadata.locref_config is not None
    assert metadata.bodyparts == Fake().names


def test_threads_that_share_pictures_find_what_one_finds():
    pictures = np.random.default_rng(1).integers(0, 255, (3, 224, 176, 3), dtype=np.uint8)
    one, two = (KeypointModel(BENCH, threads=threads).run(pictures) for threads in (1, 2))
    for alone, shared in zip(one, two, strict=True):
        np.testing.assert_allclose(shared, alone, atol=1e-6)
