"""Claims about offsets of key points from another part of a session."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from finforce_eval.errors import OptionError, RecordingError
from finforce_eval.evaluation.contact_source import ContactChoice
from finforce_eval.evaluation.forces import estimate_forces
from finforce_eval.evaluation.setup import EvaluationSetup
from finforce_eval.evaluation.tare_source import TareSource, borrow_tares, parse_tare_source
from finforce_eval.recordings.tracks import JawTrack, KeypointTrack, Recording
from finforce_ifea.estimator import ForceEstimator
from finforce_ifea.jaw.calibration import load_calibration
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.settings import EstimatorSettings

PERIOD, NOISE = 33_333_333, 0.02e-3
MOUNT = np.array([0.2e-3, 0.0, 0.1e-3])  # m, by which this camera is off


class Sight:
    """Stands for the detector: the key points of a recording are there already."""

    def __init__(self):
        self.asked = []

    def apply(self, recording):
        self.asked.append(recording.name)
        return recording


class Images:
    def __init__(self, stamps):
        self.stamps_ns = stamps

    def at(self, stamps):
        return Images(stamps)


@pytest.fixture(scope="module")
def jaw():
    return load_jaw("bench")


@pytest.fixture(scope="module")
def setup():
    contacts = ContactChoice(mode="fixed", height_mm=40.0)
    calibration = load_calibration("bench")
    return EvaluationSetup(
        jaw=load_jaw("bench"), settings=EstimatorSettings(), calibration=calibration, contacts=contacts, about={}
    )


@cache
def find_modes():
    return ForceEstimator("bench", calibration="bench")._tracked.rest_modes()


def record(jaw, bends, offset=MOUNT, name="one", seed=0):
    """Key points of a jaw that an object has bent by so much [m], one image after the other."""
    random, count = np.random.default_rng(seed), len(bends)
    points = jaw.keypoints + offset + random.normal(0.0, NOISE, (count, *jaw.keypoints.shape))
    points[:, :, [0, 2]] += np.asarray(bends)[:, None, None] * find_modes()
    stamps = PERIOD * np.arange(count, dtype=np.int64)
    stddev = np.full(points.shape, NOISE)
    keypoints = KeypointTrack(stamps_ns=stamps, points=points, likelihood=np.ones(points.shape[:2]), stddev=stddev)
    return Recording(name=name, path=Path(name), jaws={"left": JawTrack(keypoints=keypoints)}, images=Images(stamps))


def test_an_episode_that_begins_loaded_is_answered_from_its_first_image(jaw, setup):
    pressed, other = record(jaw, [2e-3] * 60), record(jaw, [0.0] * 60, name="other", seed=1)
    alone = estimate_forces(pressed, setup)["left"]
    sight = Sight()
    tares, notes = borrow_tares(TareSource(episode=1), pressed, other, sight, setup)
    found = estimate_forces(pressed, setup, tares=tares)["left"]
    assert not alone.solved[:44].any() and found.solved.all()
    assert found.force[0, 0] == pytest.approx(np.median(found.force[:, 0]), rel=0.2) and found.force[0, 0] < -0.5
    assert "tare of episode 1" in notes[0] and "look loaded" in notes[0]
    _, notes = borrow_tares(TareSource(episode=1), record(jaw, [1e-3] * 60), other, sight, setup)
    assert "loaded from the start, bent by 0.7" in notes[0]
    assert sight.asked == ["other"]  # looked at once


def test_a_time_of_the_recording_itself_may_show_the_jaws_unloaded(jaw, setup):
    recording = record(jaw, [2e-3] * 30 + [0.0] * 60)
    tares, _ = borrow_tares(TareSource(seconds=1.2), recording, None, Sight(), setup)
    np.testing.assert_allclose(
        tares["left"].offsets[:, [0, 2]], np.tile(MOUNT[[0, 2]], (len(jaw.keypoints), 1)), atol=3e-5
    )
    found = estimate_forces(recording, setup, tares=tares)["left"]
    assert found.solved[0] and found.force[0, 0] < -0.5
    with pytest.raises(RecordingError, match=r"20 images from 2\.32 s on, 25 more unloaded frames"):
        borrow_tares(TareSource(seconds=2.32), recording, None, Sight(), setup)


def test_offsets_of_another_mount_are_refused_and_of_the_same_are_measured(jaw, setup):
    here, same = record(jaw, [0.0] * 60, name="here"), record(jaw, [0.0] * 60, name="same", seed=2)
    _, notes = borrow_tares(TareSource(episode=2), here, same, Sight(), setup)
    assert "0.00" in notes[0] or "0.01" in notes[0]
    moved = record(jaw, [0.0] * 60, MOUNT + [0.0, 0.0, 0.5e-3], name="moved", seed=3)
    with pytest.raises(RecordingError, match=r"left jaw's key points are 0\.\d+ mm from where episode 3 has them"):
        borrow_tares(TareSource(episode=3), here, moved, Sight(), setup)


def test_nothing_is_borrowed_without_a_source(jaw, setup):
    assert borrow_tares(None, replace(record(jaw, [0.0]), images=None), None, Sight(), setup) == ({}, [])


@pytest.mark.parametrize("text", ["", "s", "-1", "x", "nans", "-2s", "1.5"])
def test_what_names_no_part_of_a_session_is_refused(text):
    with pytest.raises(OptionError, match="expected the number of an episode, or seconds"):
        parse_tare_source(text)
    assert parse_tare_source("7") == TareSource(episode=7) and parse_tare_source("12.5s") == TareSource(seconds=12.5)
    assert str(parse_tare_source("12.5s")) == "12.5 s" and parse_tare_source(None) is None
