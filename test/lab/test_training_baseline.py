"""The end-to-end network learns what images show, and its file says the same as it does."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs PyTorch: pip install torch")
pytest.importorskip("onnx", reason="the export needs onnx: pip install onnx")
pytest.importorskip("onnxruntime", reason="the exported network runs on onnxruntime: pip install onnxruntime")
pytest.importorskip("cv2", reason="pictures need OpenCV: pip install opencv-contrib-python-headless")

import torch

from lab.experiments.network import HEIGHT, SHOWN, WIDTH, ForceNetwork
from lab.training.baseline.scenes import GraspFilm, draw_scenario, load_films, main
from lab.training.baseline.train import (
    NETWORK,
    SEGMENT,
    BaselineRecipe,
    BaselineTraining,
    EndToEnd,
    alter_images,
    draw_batch,
    write_network,
)
from lab.training.commands import CheckpointError, DatasetError, RecipeError
from lab.training.export import load_checkpoint
from lab.training.pictures import TRAIN, VALIDATION
from lab.training.train import CHECKPOINT

STILL = BaselineRecipe(steps=14, batch=4, shift=0, light=0.0, noise=0.0, rate=2e-3)


def draw_film(seed, count=40):
    """A bright bar as broad as the force is large."""
    rng = np.random.default_rng(seed)
    force = np.clip(np.cumsum(rng.normal(0.0, 0.3, count)) + 2.0, 0.0, 4.0).astype(np.float32)
    images = rng.integers(0, 40, (count, HEIGHT, WIDTH, 3), dtype=np.uint8)
    for image, value in zip(images, force, strict=True):
        image[40:80, : int(35 * value)] = 250
    return GraspFilm(images=images, force=force)


def test_a_force_that_shows_is_learned_and_goes_on_from_a_checkpoint(tmp_path):
    films = [draw_film(seed) for seed in range(4)]
    trainer = BaselineTraining(STILL)
    before = trainer.score(films)["rmse_N"]
    trainer.train(films, films[:1], tmp_path)
    assert trainer.score(films)["rmse_N"] < 0.7 * before
    again = BaselineTraining(replace(STILL, steps=15))
    again.resume(load_checkpoint(tmp_path / CHECKPOINT))
    assert again.step == 14
    assert again.score(films) == pytest.approx(trainer.score(films), rel=1e-3)
    network = ForceNetwork(tmp_path / NETWORK)
    windows = np.stack([films[0].images[start : start + SHOWN] for start in (0, 9)])
    with torch.no_grad():
        want = trainer.network.eval()(torch.from_numpy(windows)).numpy()
    assert network.predict(windows) == pytest.approx(want, abs=1e-3)
    assert network.about["grasps"] == 4


def test_a_checkpoint_of_another_network_is_refused(tmp_path):
    training = BaselineTraining(STILL)
    training.save(tmp_path)
    training.about = {"backbone": "resnet50"}
    with pytest.raises(CheckpointError, match="got a checkpoint of {'backbone': 'small'}, expected one of .*resnet50"):
        training.resume(load_checkpoint(tmp_path / CHECKPOINT))


def test_an_unknown_encoder_is_refused():
    with pytest.raises(RecipeError, match="expected one of small, resnet50"):
        EndToEnd("large")


def test_the_papers_encoder_can_be_had(tmp_path):
    pytest.importorskip("torchvision", reason="ResNet-50 comes from torchvision: pip install torchvision")
    network = EndToEnd("resnet50").eval()
    write_network(network, tmp_path / NETWORK, {})
    assert np.isfinite(ForceNetwork(tmp_path / NETWORK).predict(np.zeros((1, SHOWN, HEIGHT, WIDTH, 3), np.uint8))).all()


def test_images_of_a_piece_are_altered_alike():
    film, rng = draw_film(3), np.random.default_rng(1)
    assert (alter_images(film.images, STILL, rng) // 8).std() > 0.0
    moved = alter_images(np.repeat(film.images[:1], 5, axis=0), replace(STILL, shift=6, light=0.3), rng)
    assert (np.abs(moved.astype(int) - moved[:1]) <= 1).all()
    images, forces = draw_batch([film], STILL, rng)
    assert images.shape == (4, SEGMENT, HEIGHT, WIDTH, 3)
    assert forces.shape == (4, SEGMENT)


def test_grasps_are_those_of_the_paper_and_their_films_begin_open(tmp_path):
    scenes = {draw_scenario(np.random.default_rng(seed)).object for seed in range(20)}
    assert scenes == {"rod25", "block"}
    main([str(tmp_path), "--grasps", "1", "--validation", "0", "--first", "5"])
    (film,) = load_films(tmp_path, TRAIN)
    assert film.images.shape == (len(film.force), HEIGHT, WIDTH, 3)
    assert film.force[0] == 0.0
    assert film.force.max() > 0.3
    with pytest.raises(DatasetError, match="got no file val_"):
        load_films(tmp_path, VALIDATION)
