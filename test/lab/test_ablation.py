"""Rules of the estimator that are switched off, each in a process of its own."""

import pickle
from functools import reduce
from importlib import import_module

import numpy as np
import pytest

from finforce_eval.errors import OptionError
from lab.ablation.rules import RULES
from lab.ablation.run import find_compiled, list_runs, run_child, switch_off
from lab.ablation.scenes import SCENES, Press, film, tell_height
from lab.cli.ablation import choose_rules
from lab.stress.session import Bench
from lab.stress.stress import Plan

BY_NAME = {rule.name: rule for rule in RULES}


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_everything_that_a_rule_replaces_is_there_and_a_scene_reaches_it(rule):
    for place in rule.off:
        name, _, path = place.partition(":")
        reduce(getattr, path.split("."), import_module(name))
    assert rule.scenes
    assert set(rule.scenes) <= set(SCENES)


def test_a_value_that_is_compiled_in_asks_for_another_compilation_of_what_holds_it_and_of_its_callers():
    assert set(find_compiled(BY_NAME["detector bias"])) == {"process.find_decay-", "process.advance-"}
    assert {"readout.read_out-"} == {*find_compiled(BY_NAME["direction error"])}
    assert {"measurement.weigh-", "filter.update-"} <= {*find_compiled(BY_NAME["gross errors"])}
    assert find_compiled(BY_NAME["reset after a release"]) == ()


def test_a_place_that_is_gone_is_an_error():
    rule = BY_NAME["reset after a release"]
    gone = type(rule)(**{**vars(rule), "off": {"finforce_ifea.filter.tracker:_NO_SUCH_RULE": 0}})
    with pytest.raises(AttributeError, match="_NO_SUCH_RULE"), switch_off(gone):
        pass


def test_an_unknown_rule_lists_the_known_ones():
    with pytest.raises(OptionError, match="none such: expected some of Student's t; gross errors"):
        choose_rules("gross errors; none such")


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """A folder with an unloaded jaw, seen with more noise than in the tare, and with a point that comes and goes."""
    bench, random, folder = Bench(Plan()), np.random.default_rng(0), tmp_path_factory.mktemp("scenes")
    count = 120
    rest = np.tile(bench.jaw.keypoints, (count, 1, 1))
    pressed = Press(states=np.tile([0.0, 0.0125, 0.040], (count, 1)), points=rest, forces=np.zeros((count, 3)))
    scale = np.where(np.arange(count) < 60, 1.0, 4.0)
    scene = film(bench, pressed, tell_height(bench, pressed), random, scale)
    for image in scene.images[50:]:
        image.likelihood[:3] = 0.9 if random.random() < 0.2 else 0.1
    (folder / "noisy").write_bytes(pickle.dumps(scene))
    return folder


def test_a_rule_that_is_off_moves_its_figure_and_no_other_run(scenes):
    """The level of the noise stands in Python, the weights of key points in compiled code."""
    plain, compiled, other = (BY_NAME[name] for name in ("noise level", "presence", "reset after a release"))
    assert list_runs([compiled, plain]) == [[plain], [compiled]]
    # one process for many rules restores each
    without_plain, without_other = run_child([plain, other], scenes, names=["noisy"])
    (without_compiled,) = run_child([compiled], scenes, names=["noisy"])
    (usual,) = run_child((), scenes, names=["noisy"])
    assert usual["noisy"] not in (without_plain["noisy"], without_compiled["noisy"])
    assert next(run_child([other], scenes, names=["noisy"])) == without_other
