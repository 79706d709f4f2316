"""Other forms of the shipped network: they load, and see what it sees."""

import numpy as np
import pytest

pytest.importorskip("onnx")

from finforce_eval.bench.network_variants import SIZES, _resize_maps, write_dynamic, write_small, write_static
from finforce_keypoints.build import SHIPPED
from finforce_keypoints.detectors.side_plane import grid_from_metadata
from finforce_keypoints.networks.model import KeypointModel


def stripes(model, seed=0):
    """A smooth picture of the network's size, as a batch of one."""
    height, width = model.training_size
    rows, columns = np.mgrid[:height, :width]
    phases = np.random.default_rng(seed).uniform(0.0, 6.0, 3)
    waves = [np.sin(columns / 19.0 + rows / 11.0 + phase) for phase in phases]
    return (127.0 + 90.0 * np.stack(waves, axis=-1)).astype(np.uint8)[None]


@pytest.fixture(scope="module")
def shipped():
    return KeypointModel(SHIPPED, threads=1)


@pytest.mark.parametrize("scale", list(SIZES))
def test_network_of_larger_pixels_loads_and_its_view_has_the_same_middle(shipped, tmp_path, scale):
    model = KeypointModel(write_small(tmp_path / "small", scale), threads=1)
    grid, before = grid_from_metadata(model.metadata.extra), grid_from_metadata(shipped.metadata.extra)
    assert (grid.height, grid.width) == SIZES[scale] == model.training_size
    middles = [entry.places((np.array([[entry.width, entry.height]]) - 1.0) / 2.0) for entry in (grid, before)]
    np.testing.assert_allclose(*middles, atol=1e-9)
    assert model.run(stripes(model))[0].shape == (1, 16, SIZES[scale][0] // 4, SIZES[scale][1] // 4)


def test_maps_of_the_same_size_stay_and_a_ramp_stays_a_ramp():
    ramp = np.arange(14.0, dtype=np.float32)[None, None, :, None].repeat(11, axis=3)
    np.testing.assert_allclose(_resize_maps(ramp, (14, 11)), ramp, atol=1e-6)
    halved = _resize_maps(ramp, (7, 5))[0, 0, :, 0]
    np.testing.assert_allclose(halved, 0.5 + 2.0 * np.arange(7), atol=1e-6)


def test_eight_bits_change_the_maps_a_little_and_not_to_the_bit(shipped, tmp_path):
    picture = stripes(shipped)
    inputs = [shipped.preprocess(stripes(shipped, seed)).copy() for seed in range(3)]
    exact = shipped.run(picture)[1]
    for name, folder in (
        ("dynamic", write_dynamic(tmp_path / "dynamic")),
        ("static", write_static(tmp_path / "static", inputs)),
    ):
        maps = KeypointModel(folder, threads=1).run(picture)[1]
        off = np.abs(maps - exact).mean() / np.abs(exact).mean()
        assert 1e-6 < off < 0.3, name  # 8 bits through 22 layers; another network's maps are off by about 1
