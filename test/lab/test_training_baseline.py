"""Claims about the paper's baseline network: it learns what images show, and its grasps are those of the twin."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs PyTorch: pip install torch==2.13.0")

import torch

from finforce_eval.evaluation.scoring import ONSET_FORCE
from finforce_keypoints.images import RgbdImage
from finforce_sim.simulated_recording import parse_size
from lab.training.baseline import (
    JUDGED,
    PIECE,
    SHOWN,
    BaselineTraining,
    change_piece,
    draw_pieces,
    follow_images,
    load_baseline,
)
from lab.training.commands import TrainingError
from lab.training.export import load_checkpoint
from lab.training.grasps import EDGE, HEIGHTS, GraspImages, load_grasps, shrink_image, write_grasps
from lab.training.train import CHECKPOINT, FingerTraining, Recipe

SHORT = Recipe(steps=16, batch=2, rate=1e-2)


def draw_bars(grasps=3, count=30):
    """A bright bar as broad as the force is large."""
    rng = np.random.default_rng(0)
    force = np.clip(2.0 + np.cumsum(rng.normal(0.0, 0.3, grasps * count)), 0.0, 4.0).astype(np.float32)
    images = rng.integers(0, 40, (grasps * count, EDGE, EDGE, 3), dtype=np.uint8)
    for image, value in zip(images, force, strict=True):
        image[30:60, : int(20 * value) + 4] = 250
    return GraspImages(images=images, force=force, starts=count * np.arange(grasps + 1))


def test_a_force_that_shows_is_learned_in_the_loop_of_the_key_point_network_and_goes_on(tmp_path):
    grasps = draw_bars()
    training = BaselineTraining(SHORT)
    batch = next(draw_pieces(grasps, [1, 2], 2, np.random.default_rng(0)))
    before = training.learn(batch)["force"]
    training.train(grasps, tmp_path)
    checkpoint = load_checkpoint(tmp_path / CHECKPOINT)
    again = BaselineTraining(SHORT)
    again.resume(checkpoint)
    assert again.step == 16
    assert again.score(grasps, [0]) == pytest.approx(training.score(grasps, [0]), rel=1e-3)
    assert training.learn(batch)["force"] < 0.6 * before
    with pytest.raises(TrainingError, match="expected one of"):
        FingerTraining(SHORT).resume(checkpoint)


def test_a_checkpoint_gives_forces_from_the_tenth_image_on(tmp_path):
    grasps, training = draw_bars(), BaselineTraining(replace(SHORT, steps=1))
    training.train(grasps, tmp_path)
    network, camera = load_baseline(tmp_path / CHECKPOINT), parse_size("96x96")
    shown = [(k, RgbdImage(stamp=k / 30.0, color=grasps.images[k], depth=None, camera=camera)) for k in range(12)]
    forces = follow_images(network, shown)
    with torch.no_grad():
        features = network.encode(torch.from_numpy(grasps.images[:12]))
        assert list(forces.values()) == pytest.approx(network.follow(features).tolist(), abs=1e-4)
    assert list(forces) == list(range(SHOWN - 1, 12))
    (tmp_path / "none.pt").write_bytes(b"none")
    with pytest.raises(TrainingError, match="checkpoint"):
        load_baseline(tmp_path / "none.pt")


def test_grasps_held_back_are_never_learnt_and_a_piece_never_leaves_its_grasp():
    grasps = draw_bars(grasps=2, count=PIECE)
    images, forces = next(draw_pieces(grasps, [1], 3, np.random.default_rng(0)))
    assert images.shape == (3, PIECE, EDGE, EDGE, 3)
    assert (forces == grasps.force[PIECE:]).all()
    assert JUDGED > 1


def test_images_of_a_piece_are_changed_alike():
    still = np.repeat(draw_bars().images[:1], 5, axis=0)
    changed = change_piece(still, np.random.default_rng(3)).astype(float)
    assert changed.shape == still.shape
    assert np.abs(changed.mean(axis=(1, 2, 3)) - changed.mean()).max() < 3.0
    assert np.abs(changed - still).mean() > 1.0


def test_the_square_of_the_jaws_is_the_middle_of_the_image():
    image = np.zeros((108, 144, 3), np.uint8)
    image[:, 18:126] = 200
    assert shrink_image(image).shape == (EDGE, EDGE, 3)
    assert shrink_image(image).min() == 200


def test_a_rendered_grasp_begins_and_ends_without_force(tmp_path):
    path = tmp_path / "grasp_cylinder_40.npz"
    assert write_grasps("grasp_cylinder", 0.040, 1, 3, str(path))["images"] > PIECE
    grasps = load_grasps(tmp_path)
    assert grasps.starts.tolist() == [0, len(grasps.force)]
    assert grasps.force[0] == 0.0 and grasps.force[-1] < ONSET_FORCE and grasps.force.max() > 0.8
    assert len(HEIGHTS) == 14
    with pytest.raises(TrainingError, match="make some with"):
        load_grasps(tmp_path / "nothing")
