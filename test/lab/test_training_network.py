"""The network learns, its export says the same as it does, and its losses want what they should."""

import re
import shutil
from dataclasses import fields, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs PyTorch: pip install torch")
pytest.importorskip("onnx", reason="the export needs onnx: pip install onnx")
pytest.importorskip("onnxruntime", reason="the exported network runs on onnxruntime: pip install onnxruntime")
pytest.importorskip("cv2", reason="pictures need OpenCV: pip install opencv-contrib-python-headless")

import onnx
import torch
from training_fakes import KEYPOINTS, POINTS, draw_ladders, write_ladders

import lab.training.evaluate
from finforce_keypoints.networks.side_network import COARSE, FINE, SideNetwork
from lab.training.batches import AugmentSettings, augment, choose_pictures, load_batches
from lab.training.commands import TrainingError
from lab.training.evaluate import Detections, fit_factor, fit_shift, score_detections
from lab.training.export import load_checkpoint, read_network, save_checkpoint, shift_likelihoods, write_network
from lab.training.export import main as export_main
from lab.training.network import FingerNetwork, NetworkShape, fold_batch_norm
from lab.training.pictures import MARGIN, TRAIN, VALIDATION, FingerPictures, load_pictures, save_shard
from lab.training.quantize import quantize_network
from lab.training.train import (
    CHECKPOINT,
    COVERED,
    FingerTraining,
    Recipe,
    choose_points,
    compute_losses,
    compute_rate,
    detect,
)
from lab.training.train import main as train_main

STILL = AugmentSettings(
    shift=2.0, scale=0.0, rotation=0.0, perspective=0.0, dim=0.0, color=0.0, gradient=0.0, blur=0.0, sharpen=0.0,
    noise=0.0, jpeg=0.0, occlusion=0.0, resample=0.0,
)  # fmt: skip


def build_trained_like(seed=0):
    """A network whose batch norms have statistics of their own, as after training."""
    torch.manual_seed(seed)
    network = FingerNetwork()
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_(std=0.2)
            module.running_var.uniform_(0.5, 2.0)
            module.weight.data.uniform_(0.5, 1.5)
            module.bias.data.normal_(std=0.2)
    network.coarse.places.data.normal_()
    return network.eval()


def test_export_says_what_the_network_says(tmp_path):
    network, pictures = build_trained_like(), draw_ladders(2, 2, 7)
    write_network(network, tmp_path, 1.0)
    assert sum((tmp_path / name).stat().st_size for name in (COARSE, FINE)) < 10e6
    here, there = detect(network, pictures), lab.training.evaluate.detect(SideNetwork(tmp_path, threads=1), pictures)
    # pieces are cut from bytes there, from floats here, and a template's half has bytes, too
    np.testing.assert_allclose(there.pixels, here.pixels, atol=0.2)
    np.testing.assert_allclose(there.likelihood, here.likelihood, atol=0.02)
    np.testing.assert_allclose(there.stddev, here.stddev, rtol=0.05)


def test_folded_weights_come_back_from_the_export(tmp_path):
    for number, network in enumerate((build_trained_like(), FingerNetwork().eval())):  # the second has equal weights
        write_network(network, tmp_path / str(number), 1.5)
        folded, (again, factor) = fold_batch_norm(network), read_network(tmp_path / str(number))
        assert factor == 1.5
        for name, weights in folded.named_parameters():
            torch.testing.assert_close(again.state_dict()[name], weights.data, msg=name)


def test_a_network_in_bytes_is_the_same_but_for_their_steps(tmp_path):
    network, pictures = build_trained_like(), draw_ladders(3, 3, 7)
    write_network(network, tmp_path, 1.5)
    before = lab.training.evaluate.detect(SideNetwork(tmp_path, threads=1), pictures)
    size = sum((tmp_path / name).stat().st_size for name in (COARSE, FINE))
    quantize_network(tmp_path, pictures)
    assert sum((tmp_path / name).stat().st_size for name in (COARSE, FINE)) < 0.4 * size
    nodes = onnx.load(str(tmp_path / FINE)).graph.node
    maker = {name: node.op_type for node in nodes for name in node.output}
    rounded = [maker[node.input[0]] for node in nodes if node.op_type == "Relu"]
    assert rounded and "DequantizeLinear" not in rounded  # a convolution and its ReLU are one to onnxruntime
    after = lab.training.evaluate.detect(SideNetwork(tmp_path, threads=1), pictures)
    assert np.median(np.abs(after.pixels - before.pixels)) < 0.5  # random weights pass errors on as trained ones do not
    again, factor = read_network(tmp_path)
    assert factor == 1.5
    for name, weights in fold_batch_norm(network).named_parameters():
        step = weights.detach().abs().max() / 127.0
        torch.testing.assert_close(again.state_dict()[name], weights.data, atol=float(step), rtol=0.02, msg=name)


def test_shifted_likelihoods_lose_the_wanted_share_and_move_no_point(tmp_path):
    write_network(build_trained_like(), tmp_path / "network", 1.5)
    quantize_network(tmp_path / "network", draw_ladders(3, 3, 7))
    dataset = write_ladders(tmp_path / "data", 1, 1)
    pictures = load_pictures(dataset, VALIDATION)
    shutil.copytree(tmp_path / "network", tmp_path / "shifted")
    found = lab.training.evaluate.detect(SideNetwork(tmp_path / "network", threads=1), pictures)
    shift_likelihoods(tmp_path / "shifted", fit_shift(found, 0.25))
    before, after = (
        lab.training.evaluate.detect(SideNetwork(tmp_path / name, threads=1), pictures)
        for name in ("network", "shifted")
    )
    assert score_detections(after).visible_lost == pytest.approx(0.25, abs=1.0 / after.visible.sum())
    np.testing.assert_array_equal(after.pixels, before.pixels)
    np.testing.assert_array_equal(after.stddev, before.stddev)


def test_what_is_no_export_cannot_be_trained_further(tmp_path):
    with pytest.raises(TrainingError, match="expected a network exported by training"):
        read_network(tmp_path)


def test_pictures_in_less_light_give_nearly_the_same():
    network, pictures = build_trained_like(), draw_ladders(1, 1, 3)
    dim = replace_picture(pictures, (pictures.picture // 2).astype(np.uint8))
    mirrored = replace_picture(pictures, pictures.picture[:, :, ::-1].copy())
    bright, dark, other = (detect(network, which).pixels for which in (pictures, dim, mirrored))
    assert np.abs(bright - dark).mean() < 0.2 * np.abs(bright - other).mean()


def replace_picture(pictures, picture):
    return FingerPictures(**{**vars(pictures), "picture": picture})


def test_points_that_are_not_told_teach_nothing_of_places():
    torch.manual_seed(0)
    network = FingerNetwork()
    batch = next(load_batches(draw_ladders(2, 3, 1), STILL, 4))
    nothing = replace(batch, places=torch.full_like(batch.places, torch.nan), visible=torch.zeros_like(batch.visible))
    losses = compute_losses(network, nothing, low=False)
    assert losses.coarse == 0.0 and losses.fine == 0.0 and losses.likely == 0.0 and losses.seen > 0.0
    assert torch.isfinite(sum(vars(compute_losses(network, batch, low=False)).values()))


def test_hidden_points_are_always_among_those_that_teach():
    torch.manual_seed(0)
    batch = next(load_batches(draw_ladders(3, 4, 1), STILL, 12))
    own = torch.arange(POINTS) < KEYPOINTS
    hidden = own & (torch.rand(12, POINTS) < 0.2)
    chosen = choose_points(replace(batch, visible=~hidden))
    taken = torch.zeros(12, POINTS, dtype=torch.bool).scatter(1, chosen, True)
    assert hidden.any(dim=1).sum() > 6
    assert ((taken & hidden).sum(dim=1) >= hidden.sum(dim=1).clamp(max=COVERED)).all()
    assert (taken & ~hidden & own).any(dim=1).all()


def test_a_certain_mistake_costs_more_than_an_uncertain_one():
    torch.manual_seed(0)
    network = FingerNetwork()
    batch = next(load_batches(draw_ladders(2, 3, 1), STILL, 4))
    costs = []
    for spread in (-3.0, 0.0):
        network.fine.judge[2].bias.data[1] = spread
        torch.manual_seed(1)
        costs.append(float(compute_losses(network, batch, low=False).likely.detach()))
    assert costs[0] > 3.0 * abs(costs[1])


def test_a_template_of_another_finger_is_in_no_picture():
    pictures = draw_ladders(3, 4, 1)
    batches = load_batches(pictures, STILL, 12)
    wrong = [batch.visible.any(dim=1) for _, batch in zip(range(20), batches, strict=False)]
    share = 1.0 - float(torch.cat(wrong).float().mean())
    assert 0.03 < share < 0.2


def test_turned_and_shifted_pictures_keep_their_points():
    pictures, rng = draw_ladders(2, 4, 11), np.random.default_rng(3)
    settings = AugmentSettings(dim=0.0, color=0.0, gradient=0.0, blur=0.0, noise=0.0, occlusion=0.0, resample=0.0)
    seen = 0
    for i in range(len(pictures)):
        before = pictures.picture[i]
        sample = augment(before, pictures.place[i], pictures.visible[i], settings, rng)
        assert sample.picture.shape == (224, 176, 3)
        for k in np.flatnonzero((sample.visible & pictures.visible[i])[:KEYPOINTS]):
            column, row = np.round(sample.points[k]).astype(int)
            old_column, old_row = np.round(pictures.place[i, k]).astype(int)
            old = before[old_row, old_column].astype(float).sum()
            if old > 0.0:  # another point's cover may lie on it
                assert 0.4 < sample.picture[row, column].astype(float).sum() / old < 1.6
                seen += 1
    assert seen > 20


def test_what_is_covered_or_outside_is_not_visible():
    pictures, rng = draw_ladders(1, 1, 2), np.random.default_rng(0)
    settings = AugmentSettings(occlusion=1.0)
    covered = [
        augment(pictures.picture[0], pictures.place[0], pictures.visible[0], settings, rng).visible.sum()
        for _ in range(20)
    ]
    assert min(covered) < pictures.visible[0].sum()
    outside = pictures.place[0].copy()
    outside[0] = (-3.0, 100.0)
    everything = np.ones(POINTS, bool)
    assert not augment(pictures.picture[0], outside, everything, STILL, rng).visible[0]


def test_a_camera_with_larger_pixels_blurs_and_keeps_the_size():
    pictures = draw_ladders(1, 1, 5)
    settings = replace(STILL, resample=1.0, coarsest=0.3)
    rng = np.random.default_rng(1)
    coarse = [
        augment(pictures.picture[0], pictures.place[0], pictures.visible[0], settings, rng).picture for _ in range(9)
    ]
    sharp = augment(pictures.picture[0], pictures.place[0], pictures.visible[0], STILL, rng).picture
    detail = [np.abs(np.diff(picture.astype(float), axis=0)).mean() for picture in coarse]
    assert {picture.shape for picture in coarse} == {sharp.shape}
    assert np.median(detail) < 0.7 * np.abs(np.diff(sharp.astype(float), axis=0)).mean()


def make_batch(workers, seed, path=None):
    batch = next(load_batches(draw_ladders(2, 3, 1), AugmentSettings(), 4, workers=workers, seed=seed))
    if path is not None:
        torch.save(batch, path)
    return batch


def test_the_same_seed_makes_the_same_batches_whoever_makes_them(tmp_path):
    # a process that has threads, as this one, is not to be forked
    apart = get_context("spawn").Process(target=make_batch, args=(1, 1, tmp_path / "batch.pt"))
    apart.start()
    apart.join(120.0)
    assert apart.exitcode == 0
    here, there, other = make_batch(0, 1), torch.load(tmp_path / "batch.pt", weights_only=False), make_batch(0, 2)
    torch.testing.assert_close(here.pictures, there.pictures)
    torch.testing.assert_close(here.places, there.places, equal_nan=True)
    assert not torch.equal(here.pictures, other.pictures)


def test_every_picture_comes_once_a_round():
    drawn = np.concatenate([choose_pictures(number, 4, 6, seed=0) for number in range(3)])
    assert sorted(drawn[:6]) == sorted(drawn[6:]) == list(range(6))
    assert (drawn[:6] != drawn[6:]).any()


def test_a_short_training_lowers_the_loss_and_can_go_on(tmp_path):
    dataset = write_ladders(tmp_path / "data")
    pictures, judging = load_pictures(dataset, TRAIN), load_pictures(dataset, VALIDATION)
    recipe = Recipe(steps=12, batch=4, workers=0, evaluate_every=1000.0, rate=2e-3)
    training = FingerTraining(recipe)
    batch = next(load_batches(pictures, STILL, 8))
    first = sum(training.learn(batch).values())
    training.train(pictures, judging, STILL, tmp_path / "run")
    assert sum(training.learn(batch).values()) < 0.8 * first
    checkpoint = load_checkpoint(tmp_path / "run" / CHECKPOINT)
    assert checkpoint["step"] == 12
    again = FingerTraining(recipe)
    again.resume(checkpoint)
    assert again.progress == 1.0
    with pytest.raises(TrainingError, match="expected one of"):
        FingerTraining(recipe, FingerNetwork(NetworkShape(fine=(16, 16)))).resume(checkpoint)
    given = [str(tmp_path / "run" / CHECKPOINT), "-o", str(tmp_path / "network"), "--dataset", str(dataset)]
    checkpoint["averaged"]["fine.judge.2.bias"][0] = -20.0
    save_checkpoint(tmp_path / "run" / CHECKPOINT, checkpoint)
    with pytest.raises(SystemExit, match="no visible point is accepted"):
        export_main(given)
    checkpoint["averaged"]["fine.judge.2.bias"][0] = 20.0
    save_checkpoint(tmp_path / "run" / CHECKPOINT, checkpoint)
    export_main(given)
    assert {path.name for path in (tmp_path / "network").iterdir()} == {COARSE, FINE}


def test_the_same_seed_trains_the_same_network(tmp_path):
    dataset = write_ladders(tmp_path / "data")
    for run in ("first", "again"):
        train_main([str(dataset), "-o", str(tmp_path / run), "--steps", "2", "--batch", "4", "--workers", "0"])
    first, again = (load_checkpoint(tmp_path / run / CHECKPOINT)["network"] for run in ("first", "again"))
    assert all(torch.equal(first[name], again[name]) for name in first)


def test_an_exported_network_is_trained_on(tmp_path):
    write_network(build_trained_like(), tmp_path / "network", 1.5)
    dataset, run = write_ladders(tmp_path / "data"), tmp_path / "run"
    given = [str(dataset), "-o", str(run), "--network", str(tmp_path / "network")]
    train_main([*given, "--steps", "3", "--batch", "4", "--workers", "0"])
    before, _ = read_network(tmp_path / "network")
    after = load_checkpoint(run / CHECKPOINT)["averaged"]
    changes = [float((after[name] - weights.detach()).abs().max()) for name, weights in before.named_parameters()]
    assert 0.0 < max(changes) < 0.1  # three steps away from where it began, no new weights
    train_main([str(dataset), "-o", str(run), "--resume", "--steps", "5", "--batch", "4", "--workers", "0"])
    assert load_checkpoint(run / CHECKPOINT)["step"] == 5


def test_a_broken_checkpoint_is_refused(tmp_path):
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(b"no checkpoint")
    with pytest.raises(TrainingError, match="expected a checkpoint written by training"):
        load_checkpoint(path)


def make_detections(pixels, points, visible, likelihood=None, stddev=None, counts=None):
    likelihood = np.ones(visible.shape) if likelihood is None else likelihood
    return Detections(
        pixels=pixels,
        points=points,
        visible=visible,
        likelihood=likelihood,
        stddev=np.ones(visible.shape) if stddev is None else stddev,
        counts=np.ones(visible.shape, bool) if counts is None else counts,
    )


def test_scores_count_what_they_say():
    points = np.zeros((2, 3, 2))
    pixels = points + [[[3.0, 4.0], [0.0, 1.0], [0, 0]], [[0.0, 0.0], [9.0, 9.0], [0, 0]]]
    likelihood = np.array([[0.9, 0.7, 0.9], [0.2, 0.95, 0.1]])
    visible = np.array([[True, True, False], [True, False, False]])
    counts = np.array([[True, True, False], [True, True, False]])  # no picture has a third point
    score = score_detections(make_detections(pixels, points, visible, likelihood, counts=counts))
    assert (score.median, score.worst) == (3.0, 5.0)
    assert score.hidden_accepted == 1.0
    assert score.visible_lost == pytest.approx(1 / 3)


def test_the_factor_of_deviations_is_that_of_the_errors():
    rng, shape = np.random.default_rng(0), (4000, 1)
    stddev = rng.uniform(0.2, 3.0, shape)
    pixels = 1.7 * stddev[..., None] * rng.standard_normal((*shape, 2))
    found = make_detections(pixels, 0.0 * pixels, np.ones(shape, bool), stddev=stddev)
    assert fit_factor(found) == pytest.approx(1.7, rel=0.05)


def test_the_rate_rises_and_falls():
    recipe = Recipe(rate=1.0, warm_up=0.1)
    rates = [compute_rate(progress, recipe) for progress in (0.0, 0.1, 0.55, 1.0)]
    np.testing.assert_allclose(rates, [0.02, 1.0, 0.505, 0.01], atol=1e-9)


@pytest.mark.parametrize("change", [{"minutes": 0.0}, {"rate": 2.0}, {"average": 1.0}, {"batch": 0}])
def test_a_recipe_out_of_bounds_is_refused(change):
    with pytest.raises(TrainingError):
        Recipe(**change)


def test_shards_that_are_missing_broken_or_of_another_size_are_refused(tmp_path):
    good = vars(draw_ladders(1, 2, 1))
    with pytest.raises(TrainingError, match="no shard"):
        load_pictures(tmp_path, TRAIN)
    (tmp_path / "train_0.npz").write_bytes(b"")
    with pytest.raises(TrainingError, match="expected a shard"):
        load_pictures(tmp_path, TRAIN)
    save_shard(tmp_path / "train_0.npz", FingerPictures(**good))
    save_shard(tmp_path / "train_1.npz", FingerPictures(**{**good, "picture": good["picture"][:, 1:]}))
    with pytest.raises(TrainingError, match="train_1"):
        load_pictures(tmp_path, TRAIN)


def test_shards_are_read_one_after_the_other_until_there_are_enough(tmp_path):
    shards = [draw_ladders(2, 2, seed) for seed in range(3)]
    for number, shard in enumerate(shards):
        save_shard(tmp_path / f"train_{number}.npz", shard)
    joined = FingerPictures.join(shards)
    for limit, count in ((None, 12), (12, 12), (5, 8), (4, 4)):
        loaded = load_pictures(tmp_path, TRAIN, limit)
        assert len(loaded) == count
        for name in ("picture", "place", "visible", "finger"):
            np.testing.assert_array_equal(getattr(loaded, name), getattr(joined, name)[:count])


def test_few_pictures_are_mixed_with_many_half_and_half():
    few, many = draw_ladders(1, 2, 1), draw_ladders(2, 5, 2)
    mixed = few.take(np.array([0])).mixed_with(many)
    assert len(mixed) == 20 and (mixed.finger[:10] == 0).all() and set(mixed.finger[10:]) == {1, 2}
    wide = few.widened(2 * POINTS + 3)
    assert wide.rest.shape == (2, 2 * POINTS + 3, 2)
    np.testing.assert_array_equal(wide.rest[:, POINTS : 2 * POINTS], few.rest)
    assert few.middle.shape == (2, 224, 176, 3) and few.picture.shape[1] == 224 + 2 * MARGIN


def test_every_setting_is_read():
    folder = Path(__file__).parents[2] / "lab" / "training"
    for record, name in ((Recipe, "train"), (AugmentSettings, "batches")):
        source = (folder / f"{name}.py").read_text()
        unread = [item.name for item in fields(record) if not re.search(rf"(recipe|settings)\.{item.name}\b", source)]
        assert unread == []
