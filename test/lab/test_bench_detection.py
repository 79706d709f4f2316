"""The benchmark of key points: who sees which image, and what is counted of it."""

from types import SimpleNamespace

import numpy as np
import pytest
from rgbd_fakes import FakeDetector, FakePhotographer, make_footage

from finforce_eval.cli.twin import write_footage
from finforce_eval.recordings.recording import read_recording
from lab.bench import detection as bench
from lab.bench.detection import Way, measure_ways


class Watched(FakeDetector):
    """Keeps what it was shown, and how often it was reset."""

    def __init__(self, recording, **options):
        super().__init__(recording, **options)
        self.seen, self.resets = [], 0

    def detect(self, image):
        self.seen.append(image.color)
        return super().detect(image)

    def reset(self):
        self.resets += 1


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write_footage(make_footage(photographer=FakePhotographer()), tmp_path_factory.mktemp("bags") / "twin")


@pytest.fixture
def detectors(monkeypatch, bag):
    """The detectors of the ways, by name; "blind" finds nothing in half of the images."""
    made = {}

    def begin(way, recording):
        made[way.name] = Watched(recording, lost=range(0, 12, 2) if way.name == "blind" else ())
        return bench._DetectionRun(way=way, detector=made[way.name], found={"left": {}})

    monkeypatch.setattr(bench, "_begin", begin)
    monkeypatch.setattr(bench, "find_scene", lambda scene: bag)
    return made


def test_every_way_sees_every_image_once_and_its_errors_are_those_of_its_detector(detectors):
    figures = measure_ways([Way(name="plain"), Way(name="blind")], [bench.GRASP])
    plain, blind = figures.tables["detection"].to_dict("records")
    assert len(detectors["plain"].seen) == len(detectors["blind"].seen) == 12
    # the fake detector is off by (0.6, 0.8) px and 0.3 mm, and accepts two of the three visible points
    assert plain["pixel error median/px"] == pytest.approx(1.0)
    assert plain["point error median/mm"] == pytest.approx(0.3)
    assert plain["visible accepted/%"] == pytest.approx(200.0 / 3.0)
    assert blind["visible accepted/%"] == pytest.approx(100.0 / 3.0)
    assert plain["n"] == 11  # the first image also compiles


def test_only_so_many_images_as_asked_for_are_seen_and_scored(detectors):
    table = measure_ways([Way(name="plain")], [bench.GRASP], count=5).tables["detection"]
    assert len(detectors["plain"].seen) == 5 and table["n"].tolist() == [4]


def test_a_searching_way_forgets_the_jaws_before_every_image(detectors):
    measure_ways([Way(name="plain"), Way(name="searching", searches=True)], [bench.GRASP])
    assert (detectors["plain"].resets, detectors["searching"].resets) == (0, 12)


def test_dots_are_shown_to_their_own_way_only(detectors, bag):
    measure_ways([Way(name="plain"), Way(name="dots", dots=True)], [bench.GRASP])
    recorded = [image.color for _, image in read_recording(bag).images]
    assert all(np.array_equal(*pair) for pair in zip(detectors["plain"].seen, recorded, strict=True))
    assert not any(np.array_equal(*pair) for pair in zip(detectors["dots"].seen, recorded, strict=True))


def test_the_resting_way_alone_rests(monkeypatch):
    asked = {}

    def build(jaws, parameters, settings, dots, rests):
        asked[parameters.threads] = rests
        return SimpleNamespace(warm_up=lambda: None)

    monkeypatch.setattr(bench, "build_detector", build)
    recording = SimpleNamespace(images=SimpleNamespace(frame_id="camera"), case={}, jaws={"left": None})
    bench._begin(Way(name="a", parameters={"threads": 1}), recording)
    bench._begin(Way(name="b", parameters={"threads": 3}, rests=True), recording)
    assert asked == {1: False, 3: True}
