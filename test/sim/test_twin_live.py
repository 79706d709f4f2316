"""Claims about images of a grasp that are taken beforehand and shown as a gripper moves; a lens without a renderer."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from rgbd_fakes import CAMERA_POSE, FakeLens

from finforce.transforms import invert_pose
from finforce_sim.gripper import PressedGrasp
from finforce_sim.scenarios import ScenarioError, build_scenario
from finforce_sim.stored_grasp import BEFORE_TOUCH, COUNTS, OPEN_STRIDE, TAKES, LiveScene, choose_openings

STROKE = 0.048
COUNT = STROKE / COUNTS
HELD = 0.013


@pytest.fixture(scope="module")
def grasp():
    return PressedGrasp(build_scenario("grasp_cylinder"), 3, "coarse", step=1e-3)


@pytest.fixture
def scene(grasp):
    scene = LiveScene(grasp, FakeLens(), 5)
    scene.render(lambda frame: frame, lambda done, count: None)
    return scene


@pytest.fixture
def few(monkeypatch):
    """The openings that deserve an image are these."""
    return lambda openings: monkeypatch.setattr(
        "finforce_sim.stored_grasp.choose_openings", lambda grasp: np.array(openings)
    )


@dataclass
class Teller:
    """Hears how far the filming is, and may end it."""

    ends_at: int = -1
    heard: list = field(default_factory=list)

    def __call__(self, done, count):
        self.heard.append((done, count))
        if done == self.ends_at:
            raise KeyboardInterrupt


def test_every_rest_position_of_the_gripper_has_its_image_where_the_jaws_touch(grasp):
    openings = choose_openings(grasp)
    in_contact = openings[openings < grasp.touch_opening + BEFORE_TOUCH]
    np.testing.assert_allclose(in_contact, COUNT * np.arange(len(in_contact)), atol=1e-12)
    assert in_contact[-1] > grasp.touch_opening + BEFORE_TOUCH - COUNT
    free = openings[len(in_contact) :]
    np.testing.assert_allclose(np.diff(free), OPEN_STRIDE * COUNT, atol=1e-12)
    assert openings[-1] == pytest.approx(STROKE)


def test_no_image_is_taken_of_jaws_that_jam(grasp, monkeypatch):
    monkeypatch.setattr(grasp, "least_opening", 0.0105)
    openings = choose_openings(grasp)
    assert 0.0105 <= openings[0] < 0.0105 + COUNT


@pytest.mark.parametrize(
    ("opening", "place"),
    [(-0.1, 0), (0.0, 0), (0.0014, 0), (0.0016, 1), (0.003, 1), (0.0074, 1), (0.0076, 2), (1.0, 2)],
)
def test_the_nearest_image_is_shown(grasp, opening, place):
    scene = LiveScene(grasp, FakeLens(), 5)
    scene.openings = np.array([0.0, 0.003, 0.012])
    assert scene.find(opening) == place


def test_images_are_of_their_openings_and_no_two_takes_are_alike(grasp, few):
    few([0.0, 0.010, 0.030])
    scene, teller = LiveScene(grasp, FakeLens(), 5), Teller()
    scene.render(lambda frame: frame, teller)
    assert teller.heard == [(1, 3), (2, 3), (3, 3)]
    shown = [(opening, [scene.take(opening, 0.0).picture for _ in range(TAKES)]) for opening in scene.openings]
    pictures = [frame.color.tobytes() for _, takes in shown for frame in takes]
    assert len(pictures) == len(set(pictures)) == TAKES * 3
    for opening, takes in shown:
        state = grasp.state(opening)
        for frame in takes:
            np.testing.assert_array_equal(frame.jaws["left"].points, state.jaws["left"].keypoints)
            np.testing.assert_array_equal(frame.jaws["right"].force, state.jaws["right"].force)


def test_the_same_seed_gives_the_same_images_whatever_the_threads(grasp, few, monkeypatch):
    few(np.linspace(0.0, 0.03, 12))
    reels = []
    for workers in (1, 4):
        monkeypatch.setattr("finforce_sim.stored_grasp.WORKERS", workers)
        scene = LiveScene(grasp, FakeLens(), 5)
        scene.render(lambda frame: frame.color, lambda done, count: None)
        reels.append([scene.take(opening, 0.0).picture for opening in scene.openings for _ in range(TAKES)])
    np.testing.assert_array_equal(reels[0], reels[1])


def test_filming_that_is_ended_does_not_go_on(grasp, few):
    lens = FakeLens()
    few(np.linspace(0.0, 0.048, 200))
    with pytest.raises(KeyboardInterrupt):
        LiveScene(grasp, lens, 5).render(lambda frame: frame, Teller(ends_at=2))
    # what the threads had begun, and what they took while the end was on its way
    assert lens.looks < 100


def test_a_gripper_that_stands_still_is_never_shown_twice_by_the_same_image(scene):
    pictures = [scene.take(HELD, 0.033 * k).picture for k in range(6)]
    assert all(a is not b for a, b in zip(pictures[:-1], pictures[1:], strict=True))
    shown = scene.grasp.state(scene.openings[scene.find(HELD)])
    for picture in pictures:
        np.testing.assert_array_equal(picture.jaws["left"].points, shown.jaws["left"].keypoints)


def test_true_forces_follow_the_true_opening_and_relax_in_time(scene):
    relaxation = scene.grasp.relaxation()
    stamps = 0.1 * np.arange(60)
    openings = np.interp(stamps, [0.0, 1.0, 2.0], [0.03, 0.03, HELD])
    for count, (stamp, opening) in enumerate(zip(stamps, openings, strict=True)):
        wrenches = scene.take(float(opening), float(stamp)).wrenches
        elastic = scene.grasp.wrenches(float(opening))
        for side, wrench in wrenches.items():
            wanted = relaxation[side].update(elastic[side], 0.1 if count else 0.0)
            np.testing.assert_allclose(wrench.force, wanted.force, atol=1e-9)
    assert np.linalg.norm(wrenches["left"].force) > 1.0


def test_the_object_is_tracked_at_a_third_of_the_images_where_it_is_seen():
    # on the bench the object moves
    scene = LiveScene(PressedGrasp(build_scenario("bench_cylinder"), 3, "coarse", step=1e-3), FakeLens(), 5)
    scene.render(lambda frame: frame, lambda done, count: None)
    poses = [scene.take(HELD, 0.033 * k).T_camera_object for k in range(9)]
    assert [pose is not None for pose in poses] == [True, False, False] * 3
    seen = scene.openings[scene.find(HELD)]
    true = invert_pose(CAMERA_POSE) @ scene.grasp.pose_at(seen)
    tracked = [pose for pose in poses if pose is not None]
    for pose in tracked:
        assert 0.0 < np.abs(pose[:3, 3] - true[:3, 3]).max() < 1.5e-3  # five standard deviations
    assert not np.array_equal(tracked[0], tracked[1])


def test_an_object_that_fills_the_gripper_is_refused():
    grasp = PressedGrasp(build_scenario("grasp_cylinder", object="cylinder"), 3, "coarse", step=5e-4)
    with pytest.raises(ScenarioError, match="50 mm wide.*expected at most 46 mm"):
        LiveScene(grasp, FakeLens(), 0)
