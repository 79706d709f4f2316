"""Claims about the network of any finger as a file: what is refused, and that the shipped one says what it sees."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints.build import ANY_FINGER
from finforce_keypoints.errors import DetectionError, ModelError
from finforce_keypoints.geometry.template import draw_template, find_shape, fit_grid
from finforce_keypoints.networks.side_network import COARSE, FINE, METADATA, SideNetwork, cut_pieces

RNG = np.random.default_rng(3)


@pytest.fixture(scope="module")
def network():
    return SideNetwork(ANY_FINGER, threads=1)


def draw(count, network):
    return RNG.integers(0, 255, (count, network.height, network.width, 3), dtype=np.uint8)


def prepare(network, count=5, template=None):
    points = RNG.uniform(20.0, 150.0, (count, 2))
    return network.prepare(draw(1, network)[0] if template is None else template, points)


def test_every_point_of_every_picture_gets_a_place(network):
    places = network.locate(draw(3, network), [prepare(network, 7) for _ in range(3)])
    assert places.pixels.shape == (3, 7, 2) and places.likelihood.shape == places.stddev.shape == (3, 7)
    assert np.isfinite(places.pixels).all() and (places.stddev > 0.0).all()
    assert ((places.likelihood >= 0.0) & (places.likelihood <= 1.0)).all()


def test_covered_points_are_not_looked_for_and_the_others_are_found_as_before(network, monkeypatch):
    picture, whole, wanted = draw(1, network), prepare(network, 8), np.arange(8) % 3 > 0
    held = replace(whole, wanted=wanted)
    every, seen = network.locate(picture, [whole]), []
    cut = network._cut
    monkeypatch.setattr(network, "_cut", lambda image, places: seen.append(len(places)) or cut(image, places))
    some = network.locate(picture, [held])
    assert sum(seen) == wanted.sum() and not some.likelihood[0, ~wanted].any()
    np.testing.assert_allclose(some.pixels[0, wanted], every.pixels[0, wanted], atol=1e-3)


def test_pictures_in_one_batch_do_not_disturb_each_other(network):
    pictures, templates = [], []
    for name in ("bench", "umi"):
        jaw = load_jaw(name)
        grid = fit_grid(find_shape(jaw), network.width, network.height)
        drawn = draw_template(find_shape(jaw), grid)
        templates.append(network.prepare(drawn, grid.pixels(jaw.keypoints[:12, [0, 2]])))
        grey = 60 + (drawn[..., :1] // 2 + drawn[..., 1:2] // 4) * np.ones(3, np.uint8)
        pictures.append(np.roll(grey, 3, axis=1) + RNG.integers(0, 12, grey.shape, dtype=np.uint8))
    both = network.locate(np.stack(pictures), templates)
    for number, picture in enumerate(pictures):
        alone = network.locate(picture[None], [templates[number]])
        np.testing.assert_array_equal(alone.pixels[0], both.pixels[number])
        np.testing.assert_array_equal(alone.likelihood[0], both.likelihood[number])


def test_threads_share_pictures_and_change_no_place(network):
    pictures, templates = draw(5, network), [prepare(network, 6) for _ in range(5)]
    shared = SideNetwork(ANY_FINGER, threads=2).locate(pictures, templates)
    for number in range(5):
        alone = network.locate(pictures[number : number + 1], templates[number : number + 1])
        np.testing.assert_array_equal(shared.pixels[number], alone.pixels[0])
        np.testing.assert_array_equal(shared.likelihood[number], alone.likelihood[0])


def test_what_cannot_be_computed_is_said_by_every_thread():
    network = SideNetwork(ANY_FINGER, threads=2)
    with pytest.raises(DetectionError, match="cannot be computed"):
        network.locate(draw(2, network)[:, :100], [prepare(network), prepare(network)])


def test_pieces_are_those_of_a_map_also_beyond_the_picture():
    import cv2

    picture = RNG.integers(0, 255, (60, 50, 3), dtype=np.uint8)
    centres = np.array(
        [[20.25, 30.5], [3.0, -4.0], [48.75, 59.5], [-900.0, 2000.0], [np.nan, np.inf]]
    )  # exact in cv2's 1/32 px
    places = np.nan_to_num(centres, nan=-900.0, posinf=-900.0)
    steps = np.arange(16, dtype=np.float32) - 7.5
    maps = (places[:, None, None] + np.stack(np.meshgrid(steps, steps), axis=-1)).reshape(-1, 16, 2)
    wanted = cv2.remap(picture, maps.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    difference = cut_pieces(picture, centres, 16).reshape(wanted.shape).astype(int) - wanted
    assert np.abs(difference).max() <= 1


def test_black_pictures_and_points_outside_are_no_crash(network):
    template = network.prepare(np.zeros((network.height, network.width, 3), np.uint8), np.array([[-500.0, 9e3]]))
    places = network.locate(np.zeros((1, network.height, network.width, 3), np.uint8), [template])
    assert places.pixels.shape == (1, 1, 2)


def test_pictures_of_another_size_are_refused(network):
    with pytest.raises(DetectionError, match="cannot be computed"):
        network.locate(draw(1, network)[:, :100], [prepare(network)])


def test_both_files_are_needed(tmp_path):
    with pytest.raises(ModelError, match=r"no coarse\.onnx and no fine\.onnx.*detection_method frame"):
        SideNetwork(tmp_path)
    shutil.copy(ANY_FINGER / COARSE, tmp_path)
    with pytest.raises(ModelError, match=r"no fine\.onnx"):
        SideNetwork(tmp_path)
    (tmp_path / FINE).write_bytes(b"no network")
    with pytest.raises(ModelError, match="expected an ONNX network"):
        SideNetwork(tmp_path)
    shutil.copy(ANY_FINGER / COARSE, tmp_path / FINE)
    with pytest.raises(ModelError, match=r"fine\.onnx: a network of pictures, templates, points.*expected pieces"):
        SideNetwork(tmp_path)


@pytest.mark.parametrize(
    "said", [None, "no json", {}, {"kind": "other"}, {"kind": "side plane", "stddev_factor": -1.0}]
)
def test_a_file_without_its_metadata_is_refused(tmp_path, said):
    onnx = pytest.importorskip("onnx")
    shutil.copy(ANY_FINGER / FINE, tmp_path)
    model = onnx.load(str(ANY_FINGER / COARSE))
    del model.metadata_props[:]
    if said is not None:
        entry = model.metadata_props.add()
        entry.key, entry.value = METADATA, said if isinstance(said, str) else json.dumps(said)
    onnx.save(model, str(tmp_path / COARSE))
    with pytest.raises(ModelError, match="stddev_factor"):
        SideNetwork(tmp_path)


def test_the_files_are_small_enough_to_ship():
    assert sum((ANY_FINGER / name).stat().st_size for name in (COARSE, FINE)) < 10e6
