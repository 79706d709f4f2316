"""Rules of the estimator that are switched off, each in a process of its own."""

import pickle
from dataclasses import replace
from functools import reduce
from importlib import import_module

import numpy as np
import pytest

from finforce_ifea.observation import check_contact, check_observation
from lab.ablation.rules import RULES
from lab.ablation.run import FAMILIES, STRESS, find_compiled, list_runs, play, run_child, switch_off
from lab.ablation.scenes import SCENES, Press, build_scene, film, tell_height
from lab.stress.session import Bench
from lab.stress.stress import Plan

BY_NAME = {rule.name: rule for rule in RULES}


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_everything_that_a_rule_replaces_is_there_and_a_scene_reaches_it(rule):
    for place in rule.off:
        name, _, path = place.partition(":")
        reduce(getattr, path.split("."), import_module(name))
    assert rule.scenes
    assert set(rule.scenes) <= {*SCENES, *(STRESS + family for family in FAMILIES)}


def test_a_value_that_is_compiled_in_asks_for_another_compilation_of_what_holds_it_and_of_its_callers():
    callers = {"process.find_decay-", "process.advance-", "image_update.predict_image-"}
    assert {*find_compiled(BY_NAME["detector bias"])} == callers
    assert {"readout.read_out-", "image_update.finish-"} == {*find_compiled(BY_NAME["direction error"])}
    assert {"measurement.weigh-", "filter.update-"} <= {*find_compiled(BY_NAME["gross errors"])}
    assert find_compiled(BY_NAME["reset after a release"]) == ()


@pytest.fixture(scope="module")
def bench():
    return Bench(Plan())


@pytest.mark.parametrize("name", SCENES)
def test_the_estimator_takes_every_image_of_a_scene(name, bench, monkeypatch):
    def press(bench, depths, *, indenter=None, shape=0.0125, height=0.040, **_):
        states = np.stack(np.broadcast_arrays(depths, shape, height), axis=1)
        points = np.tile(bench.jaw.keypoints, (len(depths), 1, 1))
        still = np.zeros(len(depths))
        rest = Press(states=states, points=points, forces=np.zeros((len(depths), 3)), carried=still)
        return rest if indenter is None else replace(rest, indenter=indenter)

    monkeypatch.setattr("lab.ablation.scenes.press", press)
    scene, before = build_scene(bench, name), None
    for image, contact in zip(scene.images, scene.contacts, strict=True):
        check_observation(image, len(bench.jaw.keypoints), before)
        check_contact(contact, bench.jaw)
        before = image.stamp


def test_a_turn_that_gravity_shows_tells_the_weight_across_the_finger(bench):
    turned = build_scene(bench, "turned")
    untold = replace(turned, images=[replace(image, posture=None) for image in turned.images])
    assert play(turned)["vector/N"] < 0.8 * play(untold)["vector/N"]


def test_a_place_that_is_gone_is_an_error():
    rule = BY_NAME["reset after a release"]
    gone = type(rule)(**{**vars(rule), "off": {"finforce_ifea.filter.tracker:_NO_SUCH_RULE": 0}})
    with pytest.raises(AttributeError, match="_NO_SUCH_RULE"), switch_off(gone):
        pass


@pytest.fixture(scope="module")
def scenes(bench, tmp_path_factory):
    """A folder with an unloaded jaw, seen with more noise than in the tare, and with a point that comes and goes."""
    random, folder = np.random.default_rng(0), tmp_path_factory.mktemp("scenes")
    count = 120
    rest = np.tile(bench.jaw.keypoints, (count, 1, 1))
    still = {"states": np.tile([0.0, 0.0125, 0.040], (count, 1)), "carried": np.zeros(count)}
    pressed = Press(points=rest, forces=np.zeros((count, 3)), **still)
    scale = np.where(np.arange(count) < 60, 1.0, 4.0)
    scene = film(bench, pressed, tell_height(bench, pressed), random, scale)
    for image in scene.images[50:]:
        image.likelihood[:3] = 0.9 if random.random() < 0.2 else 0.1
    (folder / "noisy").write_bytes(pickle.dumps(scene))
    return folder


def test_a_rule_that_is_off_moves_its_figure_and_no_other_run(scenes):
    """The mean time of rest stands in Python, the weights of key points in compiled code."""
    plain, compiled, other = (
        BY_NAME[name] for name in ("short rest of open jaws", "gross errors", "reset after a release")
    )
    assert list_runs([compiled, plain]) == [[plain], [compiled]]
    # one process for many rules restores each
    without_plain, without_other = run_child([plain, other], scenes, names=["noisy"])
    (without_compiled,) = run_child([compiled], scenes, names=["noisy"])
    (usual,) = run_child((), scenes, names=["noisy"])
    assert usual["noisy"] not in (without_plain["noisy"], without_compiled["noisy"])
    assert next(run_child([other], scenes, names=["noisy"])) == without_other
