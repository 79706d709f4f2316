"""Claims about the pictures of what was found in images."""

from dataclasses import replace

import numpy as np
import pytest
from eval_fakes import FakeEstimator, FakeJaw, evaluate_recording, make_recording, write_report
from rgbd_fakes import FakeDetector, FakeGripper, make_footage

from finforce_contact.loop import GivenContact
from finforce_eval.cli.twin import write_footage
from finforce_eval.evaluation.keypoint_source import detect_keypoints
from finforce_eval.evaluation.scoring import score_results
from finforce_eval.recordings.images import ImageTrack
from finforce_eval.recordings.recording import read_recording
from finforce_keypoints.diagnostics import COLORS

pytest.importorskip("matplotlib")

from finforce_eval.figures.images import (
    choose_images,
    describe_image,
    draw_images,
    find_region,
)

STAMPS = 1_000 + 10 * np.arange(100)
LOST = (3,)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Twelve images: two key points used, two refused, one of them hidden; the jaw is lost in the fourth."""
    read = read_recording(write_footage(make_footage(FakeGripper()), tmp_path_factory.mktemp("bags") / "twin"))
    return detect_keypoints(read, FakeDetector(read, lost=LOST))


@pytest.fixture(scope="module")
def result(recording):
    jaw, forces = FakeJaw(keypoints=np.zeros((4, 3))), list(recording.truth("left").force)
    forces[0] = None
    return evaluate_recording(recording, jaw, GivenContact(None), FakeEstimator(forces))


@pytest.fixture(scope="module")
def drawn(recording, result):
    return draw_images(recording, [result])


def test_six_images_are_spread_evenly():
    np.testing.assert_array_equal(choose_images(STAMPS), STAMPS[[8, 25, 41, 58, 75, 91]])
    np.testing.assert_array_equal(choose_images(STAMPS[:2]), STAMPS[:2])


@pytest.mark.parametrize("row", [0, 41, 60, 99])
def test_the_image_at_the_largest_force_is_one_of_the_six(row):
    chosen = choose_images(STAMPS, int(STAMPS[row]) + 3)
    assert STAMPS[row] in chosen and len(set(chosen)) == 6 and (np.diff(chosen) > 0).all()


def test_the_region_holds_all_pixels_of_the_image_and_a_margin():
    pixels = np.array([[200.0, 100.0], [300.0, 250.0], [np.nan, 3.0], [900.0, 5.0]])
    left, top, width, height = find_region(pixels, 640, 480)
    assert (left, top) == (188, 88) and (left + width, top + height) == (313, 263)
    # cut at the border
    assert find_region(np.array([[1.0, 2.0], [639.0, 470.0]]), 640, 480) == (0, 0, 640, 480)
    assert find_region(np.full((3, 2), np.nan), 640, 480) == (0, 0, 640, 480)


def row_of_the_first(recording):
    return int(np.flatnonzero(recording.images.stamps == choose_images(recording.images.stamps)[0])[0])


def test_what_was_found_is_coloured_by_why_it_is_not_used(recording, drawn):
    pixels = recording.jaws["left"].detection.pixels[row_of_the_first(recording)]
    dots = [line for line in drawn.axes[0].get_lines() if line.get_marker() == "o"]
    colours = {pixel: line.get_color() for line in dots for pixel in zip(*line.get_data(), strict=True)}
    for pixel, reason in zip(pixels, ("", "", "likelihood", "likelihood"), strict=True):
        np.testing.assert_allclose(255.0 * colours[tuple(pixel)], COLORS[reason])


def test_a_cross_stands_at_each_true_key_point_and_tells_the_hidden_ones(recording, drawn):
    expected = recording.jaws["left"].sight.pixels[row_of_the_first(recording)]
    visible, hidden = (line for line in drawn.axes[0].get_lines() if line.get_marker() == "+")
    np.testing.assert_allclose(np.transpose(visible.get_data()), expected[:3])
    np.testing.assert_allclose(np.transpose(hidden.get_data()), expected[3:])
    assert visible.get_color() != hidden.get_color()


def test_a_caption_tells_time_estimate_and_truth(recording, result, drawn):
    stamps = recording.images.stamps
    assert describe_image(recording, [result], int(stamps[9])) == "t = 0.30 s,  0.40 N (true 0.40 N)"
    assert describe_image(recording, [result], int(stamps[0])) == "t = 0.00 s,  no estimate (true 0.00 N)"
    assert "left 0.40 N" in describe_image(recording, [result, result], int(stamps[9]))
    titles = [axes.get_title(loc="left") for axes in drawn.axes]
    assert len(titles) == 6 and titles[-1] == "t = 0.37 s,  0.60 N (true 0.60 N)  (largest)"


def test_only_the_images_that_are_shown_are_kept(recording):
    chosen = recording.images.at(recording.images.stamps[[2, 7]])
    assert isinstance(chosen, ImageTrack) and [taken.stamp for taken in chosen] == chosen.stamps.tolist()
    assert chosen.stamps.tolist() == recording.images.stamps[[2, 7]].tolist()


def test_the_page_shows_the_pictures_of_images_only_where_there_are_any(recording, result, tmp_path):
    evaluation = score_results([result], [recording])
    keywords = {"keypoint_names": "abcd", "about": {}}
    plain = make_recording("twin")
    for folder, given in (("with", [recording]), ("without", [plain])):
        page = write_report(evaluation, tmp_path / folder, recordings=given, **keywords)
        assert ("Key points in the images" in page.read_text()) == (folder == "with")
        assert (page.parent / "twin_images.png").exists() == (folder == "with")


def test_a_recording_without_truth_is_drawn_without_crosses(recording, result):
    track = replace(recording.jaws["left"], sight=None)
    blind = replace(recording, jaws={"left": track})
    assert all(line.get_marker() != "+" for line in draw_images(blind, [result]).axes[0].get_lines())
