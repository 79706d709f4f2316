"""Claims about the benchmark of contact locations: errors and times of the same calls."""

import numpy as np
import pytest

from finforce.stamps import NANOSECONDS
from finforce_eval.recordings.recording import DEMO as RECORDING
from finforce_eval.recordings.recording import read_recording
from lab.bench import localization as bench
from lab.bench.localization import METHODS, LocatedImage, build_cylinder, measure_methods, summarise

MESH = build_cylinder(0.0125, 0.06, 48, 9)


def at_truth(jaw, mesh):
    """A way that knows the truth, which the frames' poses tell it, but for 2 mm; half of the time it finds nothing."""
    answers = iter([0.002, None] * 1000)

    def locate(T, surface, wrench):
        shift = next(answers)
        return None if shift is None else T[2, 3] + shift

    return locate


@pytest.fixture
def frames(monkeypatch):
    """Four images in contact, whose pose holds the true height."""
    made = [LocatedImage(T=np.eye(4), surface=np.zeros((1, 3)), wrench=None, true=0.0) for _ in range(4)]
    monkeypatch.setattr(bench, "follow", lambda recording, mesh, every: iter(made))
    monkeypatch.setattr(bench, "METHODS", {"near": at_truth})
    return made


def test_error_is_the_distance_to_the_true_location_over_the_images_where_one_was_found(frames):
    row = measure_methods([MESH], 5).tables["localization"].iloc[0]
    assert (row["method"], row["triangles"], row["n"]) == ("near", len(MESH.triangles), 4)
    assert row["found/%"] == 50.0
    assert row["error median/mm"] == row["largest/mm"] == pytest.approx(2.0)


def test_a_method_that_found_nothing_has_no_error():
    row = summarise("blind", 10, np.array([[1e-3, np.nan]] * 3), [1e-3])
    assert row["found/%"] == 0.0 and np.isnan(row["error median/mm"])


def test_cylinder_is_closed_of_the_size_asked_for_and_turned_outwards():
    mesh = build_cylinder(0.01, 0.05, 48, 9)
    corners = mesh.vertices[mesh.triangles]
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    # 48 chords enclose 0.3 % less than the circle
    assert abs(volume) == pytest.approx(np.pi * 0.01**2 * 0.05, rel=4e-3)
    assert len(mesh.triangles) == 2 * 48 * 10
    edges = np.sort(mesh.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()


def test_true_location_is_found_on_the_shipped_recording_by_the_default_method(monkeypatch):
    recording = read_recording(RECORDING)
    start = int(recording.jaw("left").keypoints.stamps[0])
    monkeypatch.setattr(bench, "read_recording", lambda path: recording.between(start, start + 15 * NANOSECONDS))
    monkeypatch.setattr(bench, "METHODS", dict(list(METHODS.items())[:1]))
    row = measure_methods([MESH], 20).tables["localization"].iloc[0]
    assert row["method"] == "outline and line of action" and row["n"] > 3
    assert row["found/%"] == 100.0
    assert row["error median/mm"] < 1.5  # over all images it is 0.8, the others' mean is 3
