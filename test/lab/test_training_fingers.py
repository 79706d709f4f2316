"""Claims about random fingers: what is drawn is a finger, it bends as its beams do, and the truth is in the picture."""

import argparse
from importlib.util import find_spec

import numpy as np
import pytest
import shapely

if find_spec("open3d") is None:
    pytest.skip("scenes are rendered with Open3D: pip install open3d", allow_module_level=True)
pytest.importorskip("cv2", reason="pictures need OpenCV: pip install opencv-contrib-python-headless")

from lab.training.commands import read_share
from lab.training.fingers import BentFinger, draw_finger, outline
from lab.training.pictures import MARGIN, FingerPictures
from lab.training.scenes import ANYWHERE, KEYPOINTS, STATES, FingerScenes, load_textures

SEEDS = range(8)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_finger_is_one_body_with_its_key_points_on_it(seed):
    finger = draw_finger(np.random.default_rng(seed))
    assert finger.polygon.is_valid and finger.polygon.area > 0.0
    assert 0.05 <= finger.length <= 0.15 and 3 <= len(finger.members) - 2 <= 20
    distance = shapely.distance(finger.polygon, shapely.points(finger.keypoints))
    ribs = len(finger.members) - 2
    between = 2 * (ribs + 1) if ribs < 6 and not finger.has_hinges else 0  # as `finforce jaw` proposes them
    assert distance.max() < 1e-3 and len(finger.keypoints) == 2 * ribs + between + 1


@pytest.mark.parametrize("seed", SEEDS)
def test_a_load_bends_the_finger_and_leaves_what_is_held(seed):
    rng = np.random.default_rng(seed)
    finger = draw_finger(rng)
    bent = BentFinger(finger, rng)
    states = bent.bend(0.6 * finger.length, 0.08 * finger.length, 0.0, 0.1 * finger.length, 4)
    points = np.vstack(outline(finger))
    attached = bent.attach(points)
    np.testing.assert_allclose(bent.places(attached, np.zeros(bent._count)), points, atol=1e-12)
    moved = [np.linalg.norm(bent.places(attached, q) - points, axis=1) for q in states]
    assert len(states) >= 2 and all(b.max() > a.max() for a, b in zip(moved[:-1], moved[1:], strict=True))
    held = points[:, 1] <= finger.clamped_z
    assert moved[-1][held].max() == 0.0
    # the load pushes against the front, to -x
    front = np.argmin(np.abs(points[:, 1] - 0.6 * finger.length) - 0.01 * (points[:, 0] > 0.0))
    assert (bent.places(attached, states[-1]) - points)[front, 0] < 0.0


def test_forces_balance_in_a_bent_state():
    rng = np.random.default_rng(3)
    finger = draw_finger(rng)
    bent = BentFinger(finger, rng)
    small, large = bent.bend(0.5 * finger.length, 0.1 * finger.length, 0.0, 0.02 * finger.length, 2)
    force, tangent = bent._linearize(small)
    # a small motion needs the force that the tangent says
    step = 1e-6 * (large - small)
    change = bent._linearize(small + step)[0] - force
    full = np.zeros((len(small), len(small)))
    for k in range(len(tangent)):
        full += np.diag(tangent[k, : len(small) - k], -k) + (np.diag(tangent[k, : len(small) - k], k) if k else 0.0)
    np.testing.assert_allclose(change, full @ step, atol=2e-4 * np.abs(change).max())


def test_scenes_are_the_same_for_the_same_seed_and_show_the_truth():
    first, again = FingerScenes(4).draw(), FingerScenes(4).draw()
    np.testing.assert_array_equal(first.picture, again.picture)
    np.testing.assert_array_equal(first.place, again.place)
    assert first.picture.shape == (STATES, 224 + 2 * MARGIN, 176 + 2 * MARGIN, 3)
    assert first.rest.shape == (STATES, KEYPOINTS + ANYWHERE, 2)
    assert first.visible.mean() > 0.5
    material = first.template[0, ..., 0]
    rest = np.round(first.rest[0, 2 : first.keypoints[0]]).astype(int)
    near = [material[row - 2 : row + 3, column - 2 : column + 3].max() for column, row in rest]
    assert min(near) > 100
    # at rest, and seen square to a plane, points are where the template has them
    flat = np.abs(first.place[0] - MARGIN - first.rest[0])
    if FingerScenes(4)._finger.taper == 0.0:
        assert flat.max() < 1e-3


def test_a_held_object_hides_more_of_the_finger():
    hidden = []
    for held in (0.0, 1.0):
        pictures = FingerPictures.join([FingerScenes(seed, held).draw() for seed in (4, 5)])
        keypoints = np.arange(KEYPOINTS + ANYWHERE) < pictures.keypoints[:, None]
        keypoints[:, 0] = False  # the mark may lack its dot
        hidden.append((~pictures.visible & keypoints).sum() / keypoints.sum())
    assert hidden[1] > 1.2 * hidden[0]


@pytest.mark.parametrize("text", ["1.1", "-0.1", "nan", "half"])
def test_a_share_is_between_none_and_all(text):
    assert read_share("0.25") == 0.25
    with pytest.raises(argparse.ArgumentTypeError, match="expected a number from 0 to 1"):
        read_share(text)


def test_textures_are_there_with_their_sources():
    textures = load_textures()
    assert len(textures) >= 8 and all(texture.shape[2] == 3 and texture.max() <= 1.0 for texture in textures)
    folder = __import__("lab.training.scenes", fromlist=["TEXTURES"]).TEXTURES
    said = (folder / "SOURCES.md").read_text(encoding="utf-8")
    assert all(path.stem in said for path in folder.glob("*.jpg"))
