"""The network learns, its export says the same as it does, and its losses want what they should."""

import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs PyTorch: pip install torch")
pytest.importorskip("onnx", reason="the export needs onnx: pip install onnx")
pytest.importorskip("onnxruntime", reason="the exported network runs on onnxruntime: pip install onnxruntime")
pytest.importorskip("cv2", reason="pictures need OpenCV: pip install opencv-contrib-python-headless")

import torch
from training_fakes import draw_blobs, write_blobs

from finforce_keypoints.networks.model import KeypointModel, decode
from training.augment import AugmentSettings, augment, crop_centre
from training.checkpoint import load_checkpoint
from training.dataset import MARGIN, LabelledPictures, iterate_batches, load_pictures
from training.detection import RULE, detect
from training.errors import CheckpointError, DatasetError, RecipeError
from training.evaluate import detect_with_model
from training.export import Sidecar, write_network
from training.loading import LoadingSettings, load_batches, stack_centres
from training.losses import LossWeights, compute_losses
from training.network import LOCREF_STD, STRIDE, KeypointNetwork, NetworkShape, fold_batch_norm
from training.recipe import Recipe
from training.scoring import Detections, fit_stddev, score_detections
from training.trainer import CHECKPOINT, Trainer, TrainingImages, compute_rate, train
from training.weights import read_network

NAMES = tuple(f"point_{k}" for k in range(16))
STILL = AugmentSettings(
    shift=2.0, scale=0.0, rotation=0.0, perspective=0.0, dim=0.0, color=0.0, gradient=0.0, blur=0.0, sharpen=0.0,
    noise=0.0, jpeg=0.0, occlusion=0.0,
)  # fmt: skip


def build_trained_like(seed=0):
    """A network whose batch norms have statistics of their own, as after training."""
    torch.manual_seed(seed)
    network = KeypointNetwork()
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_()
            module.running_var.uniform_(0.5, 2.0)
            module.weight.data.uniform_(0.5, 1.5)
            module.bias.data.normal_()
    network.places.data.normal_()
    return network.eval()


def write(network, folder):
    write_network(network, folder, Sidecar(names=NAMES, shape=network.shape, side_y=0.010))
    return folder


def test_export_says_what_the_network_says(tmp_path):
    network, model = build_trained_like(), KeypointModel(write(build_trained_like(), tmp_path), threads=1)
    assert model.names == NAMES
    assert (tmp_path / "keypoints.onnx").stat().st_size < 5e6
    batch = stack_centres(draw_blobs(3, 7))
    images = draw_blobs(3, 7).picture[:, MARGIN:-MARGIN, MARGIN:-MARGIN]
    heatmap, locref = model.run(images)
    with torch.inference_mode():
        logits, offsets = network(batch.pictures)
    assert heatmap.shape == (3, 16, 56, 44)
    assert locref.shape == (3, 32, 56, 44)
    # folding and onnxruntime's own order of sums: float32 rounding through 20 layers
    np.testing.assert_allclose(heatmap, torch.sigmoid(logits), atol=1e-3)
    np.testing.assert_allclose(locref, offsets, atol=2e-3 * np.abs(offsets.numpy()).max())


def test_folded_weights_come_back_from_the_export(tmp_path):
    for number, network in enumerate((build_trained_like(), KeypointNetwork())):  # the second has equal weights
        folded, again = fold_batch_norm(network), read_network(write(network, tmp_path / str(number)))
        for name, weights in folded.state_dict().items():
            torch.testing.assert_close(again.state_dict()[name], weights, msg=name)


def test_pictures_in_less_light_give_nearly_the_same():
    network, picture = build_trained_like(), draw_blobs(1, 3)
    light = stack_centres(picture).pictures
    mean = torch.tensor([0.485, 0.456, 0.406])[:, None, None] / torch.tensor([0.229, 0.224, 0.225])[:, None, None]
    dim = (light + mean) * 0.5 - mean
    with torch.inference_mode():
        bright, dark = network(light)[0], network(dim)[0]
        other = network(light.flip(3))[0]
    # standardised up to its eps of 1e-3 in a variance of some 0.1; a mirrored picture is another one
    change = (bright - other).abs().mean()
    assert (bright - dark).abs().mean() < 0.1 * change


def perfect_outputs(points, visible, weights):
    """Outputs that have the points exactly: saturated Gaussians and offsets that meet them."""
    rows, columns = (np.arange(56) + 0.5) * STRIDE, (np.arange(44) + 0.5) * STRIDE
    dx = points[..., 0, None, None] - columns[None, None, None, :] + 0.0 * rows[:, None]
    dy = points[..., 1, None, None] - rows[None, None, :, None] + 0.0 * columns
    target = np.exp(-(dx**2 + dy**2) / (2.0 * weights.sigma**2)) * visible[..., None, None]
    locref = np.stack((dx, dy), axis=2).reshape(len(points), -1, 56, 44) / LOCREF_STD
    logits = np.log(np.clip(target, 1e-6, 1 - 1e-6) / (1.0 - np.clip(target, 1e-6, 1 - 1e-6)))
    return logits.astype(np.float32), locref.astype(np.float32)


def test_decoding_of_perfect_outputs_meets_the_points_and_has_the_least_loss():
    rng, weights = np.random.default_rng(0), LossWeights()
    points = rng.uniform((5, 5), (170, 218), (2, 16, 2))
    visible = rng.random((2, 16)) < 0.7
    logits, locref = perfect_outputs(points, visible, weights)
    peaks = decode(logits, locref, RULE, (224, 176))
    np.testing.assert_allclose(peaks.pixels[visible], points[visible], atol=1e-3)
    assert (peaks.likelihood[visible] > 0.9).all()
    assert (peaks.likelihood[~visible] < 0.01).all()

    def losses(logits, locref, shown=visible):
        return compute_losses(
            torch.tensor(logits), torch.tensor(locref), torch.tensor(points).float(), torch.tensor(shown), weights
        )

    best = losses(logits, locref)
    assert best.locref < 0.06 * weights.locref  # SHARPNESS alone
    swapped = locref.reshape(2, 16, 2, 56, 44)[:, :, ::-1].reshape(locref.shape).copy()
    assert losses(logits, swapped).locref > 10.0 * best.locref
    assert losses(logits - 2.0, locref).heatmap > best.heatmap
    assert losses(logits, locref, ~visible).peak > 10.0 * best.peak
    mistaken = logits.copy()
    mistaken[~visible, 2, 3] = 3.0  # far from where the hidden points are
    assert losses(mistaken, locref).peak > 10.0 * best.peak


def test_turned_and_shifted_pictures_keep_their_points():
    pictures = draw_blobs(4, 11)
    settings = AugmentSettings(dim=0.0, color=0.0, gradient=0.0, blur=0.0, noise=0.0, occlusion=0.0)
    rng = np.random.default_rng(3)
    seen = 0
    for i in range(4):
        before = pictures.picture[i]
        sample = augment(before, pictures.xz[i], pictures.visible[i], settings, rng)
        assert sample.picture.shape == (224, 176, 3)
        for k in np.flatnonzero(sample.visible):
            column, row = np.round(sample.points[k]).astype(int)
            # a blob is brightest in its middle: 2 px beside it, no more than the noise and JPEG brighter
            old_column, old_row = np.round(pictures.xz[i, k]).astype(int)
            change = sample.picture[row, column].astype(float).sum() / before[old_row, old_column].astype(float).sum()
            assert 0.4 < change < 1.6
            seen += 1
    assert seen > 40


def test_what_is_covered_or_outside_is_not_visible():
    pictures, rng = draw_blobs(1, 2), np.random.default_rng(0)
    settings = AugmentSettings(occlusion=1.0)
    covered = [
        augment(pictures.picture[0], pictures.xz[0], pictures.visible[0], settings, rng).visible.sum()
        for _ in range(20)
    ]
    assert min(covered) < pictures.visible[0].sum()
    outside = pictures.xz[0].copy()
    outside[0] = (MARGIN - 3.0, 100.0)
    assert not crop_centre(pictures.picture[0], outside, np.ones(16, bool)).visible[0]


def test_the_same_seed_makes_the_same_batches_whoever_makes_them():
    pictures = draw_blobs(6, 1)
    here, there, other = (
        next(load_batches(pictures, AugmentSettings(), LoadingSettings(size=4, workers=workers, seed=seed)))
        for workers, seed in ((0, 1), (1, 1), (0, 2))
    )
    torch.testing.assert_close(here.pictures, there.pictures)
    torch.testing.assert_close(here.points, there.points)
    assert not torch.equal(here.pictures, other.pictures)


def test_every_picture_comes_once_a_round():
    batches = iterate_batches(6, 4, np.random.default_rng(0))
    drawn = np.concatenate([next(batches) for _ in range(3)])
    assert sorted(drawn[:6]) == sorted(drawn[6:]) == list(range(6))


def test_a_short_training_lowers_the_loss_and_can_go_on(tmp_path):
    dataset = write_blobs(tmp_path / "data", train=8, validation=4)
    pictures = TrainingImages(train=load_pictures(dataset, "train"), validation=load_pictures(dataset, "val"))
    recipe = Recipe(steps=12, batch=4, workers=0, evaluate_every=1000.0, rate=2e-3)
    trainer = Trainer(NAMES, recipe, LossWeights())
    batch = next(load_batches(pictures.train, STILL, LoadingSettings(size=4, workers=0)))
    first = trainer.learn(batch).total.item()
    train(trainer, pictures, STILL, tmp_path / "run")
    assert trainer.learn(batch).total.item() < 0.7 * first
    checkpoint = load_checkpoint(tmp_path / "run" / CHECKPOINT)
    assert checkpoint.step == 12
    again = Trainer(NAMES, recipe, LossWeights())
    again.resume(checkpoint)
    assert again.progress == 1.0
    with pytest.raises(CheckpointError, match="16 points"):
        Trainer(NAMES[:4], recipe, LossWeights()).resume(checkpoint)


def test_checkpoint_and_export_find_the_same(tmp_path):
    network, pictures = build_trained_like(), draw_blobs(3, 5)
    here, there = detect(network, pictures), detect_with_model(write(network, tmp_path), pictures)
    np.testing.assert_allclose(here.likelihood, there.likelihood, atol=1e-3)
    np.testing.assert_array_equal(here.visible, there.visible)
    np.testing.assert_allclose(here.points, there.points)


def test_a_broken_checkpoint_is_refused(tmp_path):
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(b"no checkpoint")
    with pytest.raises(CheckpointError, match="expected a checkpoint written by training"):
        load_checkpoint(path)


def test_scores_count_what_they_say():
    points = np.zeros((2, 2, 2))
    pixels = points + [[[3.0, 4.0], [0.0, 1.0]], [[0.0, 0.0], [9.0, 9.0]]]
    likelihood = np.array([[0.9, 0.7], [0.2, 0.95]])
    visible = np.array([[True, True], [True, False]])
    score = score_detections(Detections(pixels=pixels, likelihood=likelihood, points=points, visible=visible))
    assert (score.median, score.worst) == (3.0, 5.0)
    assert score.hidden_accepted == 1.0
    assert score.visible_lost == pytest.approx(1 / 3)


def test_standard_deviations_are_those_of_the_errors():
    rng, count = np.random.default_rng(0), 4000
    likelihood = rng.uniform(0.0, 1.0, (count, 1))
    stddev = np.where(likelihood > 0.5, 0.4, 6.0)
    pixels = rng.normal(0.0, 1.0, (count, 1, 2)) * stddev[..., None]
    visible = np.ones((count, 1), bool)
    table = np.array(fit_stddev(Detections(pixels=pixels, likelihood=likelihood, points=0 * pixels, visible=visible)))
    assert (np.diff(table[:, 0]) > 0).all()
    assert (np.diff(table[:, 1]) <= 0).all()
    # some 200 points a range: 5 % of a standard deviation, and 1 % of the tail cut off
    np.testing.assert_allclose(table[:, 1], np.where(table[:, 0] > 0.5, 0.4, 6.0), rtol=0.15)


def test_the_rate_rises_and_falls():
    recipe = Recipe(rate=1.0, warm_up=0.1)
    rates = [compute_rate(progress, recipe) for progress in (0.0, 0.1, 0.55, 1.0)]
    np.testing.assert_allclose(rates, [0.02, 1.0, 0.505, 0.01], atol=1e-9)


@pytest.mark.parametrize("change", [{"minutes": 0.0}, {"rate": 2.0}, {"average": 1.0}, {"batch": 0}])
def test_a_recipe_out_of_bounds_is_refused(change):
    with pytest.raises(RecipeError):
        Recipe(**change)


def test_pictures_that_do_not_fit_their_points_are_refused(tmp_path):
    good = draw_blobs(2, 1)
    with pytest.raises(DatasetError, match="expected"):
        LabelledPictures(picture=good.picture, xz=good.xz[:1], visible=good.visible)
    with pytest.raises(DatasetError, match="uint8"):
        LabelledPictures(picture=good.picture.astype(float), xz=good.xz, visible=good.visible)
    with pytest.raises(DatasetError, match="no place"):
        LabelledPictures(picture=good.picture, xz=np.full_like(good.xz, np.nan), visible=good.visible)
    with pytest.raises(DatasetError, match="no shard"):
        load_pictures(tmp_path, "train")
    (tmp_path / "train_0.npz").write_bytes(b"")
    with pytest.raises(DatasetError, match="expected a shard"):
        load_pictures(tmp_path, "train")


def test_a_network_of_another_size_cannot_be_exported(tmp_path):
    network = KeypointNetwork(NetworkShape(height=64, width=64))
    with pytest.raises(CheckpointError, match="expected 176x224"):
        write(network, tmp_path)


@pytest.mark.parametrize("record, files", [(Recipe, ["trainer", "train"]), (AugmentSettings, ["augment"])])
def test_every_setting_is_read(record, files):
    folder = Path(__file__).parents[2] / "training"
    source = "".join((folder / f"{name}.py").read_text() for name in files)
    unread = [item.name for item in fields(record) if not re.search(rf"(recipe|settings)\.{item.name}\b", source)]
    assert unread == []
