"""Claims about several nodes in one process: who gets which message, when, and what a fault of one does to others."""

import json
import subprocess
import sys
from functools import partial
from time import monotonic, sleep

import numpy as np
import pytest
from node_fakes import PATIENCE, FakeEstimator, environment, keypoint_cloud
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header, String
from std_srvs.srv import Trigger

from finforce.errors import ObservationError
from finforce.health import UNHEARD, Level, Report, Skips
from finforce.messages import CloudColumns, decode_columns, stamp_of
from finforce.ros import node as ros
from finforce.ros import topics
from finforce.ros.composition import read_part
from finforce.ros.topics import Pipeline
from finforce_ifea.node import IfeaSolverNode


class Relay(Node):
    """Hears one topic, says another, and fails when it is told to."""

    def __init__(self, pipeline, name, hears, says="", **options):
        super().__init__(name, context=options.pop("context"))
        self.stage = ros.Stage(self, pipeline)
        self.heard, self.fails, self.takes = [], False, 0.0
        self.out = self.stage.publisher(PointCloud2, says, ros.RESULT) if says else None
        self.port = self.stage.subscription(PointCloud2, hears, self.take, ros.SENSOR, **options) if hears else None
        ros.serve_trigger(self.stage, "~/ask", self.answer)
        report = Report(level=Level.OK, message="well")
        ros.publish_diagnostics(self.stage, name, 0.05, lambda alarms: report)

    def take(self, message):
        if self.fails:
            raise ValueError("no way")
        sleep(self.takes)
        self.heard.append(message)
        if self.out:
            self.say(message.columns if isinstance(message, CloudColumns) else {"x": np.zeros(1, np.float32)})

    def say(self, columns):
        ros.send_cloud(self.out, Header(), columns)

    def answer(self):
        if self.fails:
            raise ValueError("no answer")
        return "well"


@pytest.fixture
def line(probe):
    """Three relays, one behind the other, and what lets them work."""
    pipeline, executor = Pipeline(), SingleThreadedExecutor(context=probe.context)
    made = [
        Relay(pipeline, "first", "", "one", context=probe.context),
        Relay(pipeline, "second", "one", "two", context=probe.context),
        Relay(pipeline, "third", "two", "three", context=probe.context),
    ]
    pipeline.open()
    for node in made:
        executor.add_node(node)
    made[0].work = lambda condition: work(probe, executor, condition)
    yield made
    for node in made:
        executor.remove_node(node)
        node.destroy_node()


def work(probe, executor, condition):
    """Let nodes and probe work until a condition holds."""
    until = monotonic() + PATIENCE
    while not condition():
        assert monotonic() < until
        executor.spin_once()  # wakes with the timers at least
        probe.spinner.spin_once(timeout_sec=0.0)


COLUMNS = {"x": np.arange(3, dtype=np.float32)}


def test_a_message_is_through_before_its_publisher_goes_on_and_is_the_same_object(line):
    first, second, third = line
    first.say(COLUMNS)
    assert second.heard[0].columns is COLUMNS and third.heard[0].columns is COLUMNS


def test_nothing_is_packed_for_nobody_and_everything_for_who_listens_outside(line, probe, monkeypatch):
    first, second, third = line
    packed = []
    monkeypatch.setattr(topics, "pack", lambda message: packed.append(message) or ros.pack(message))

    def clouds():
        return [message for message in packed if isinstance(message, CloudColumns)]  # diagnostics go out, too

    first.say(COLUMNS)
    assert not clouds()
    probe.hear("two", PointCloud2)
    first.work(lambda: second.out.publisher.get_subscription_count() == 1)
    first.say(COLUMNS)
    first.work(lambda: probe.got["two"])
    assert len(clouds()) == 1 and len(third.heard) == 2
    np.testing.assert_array_equal(decode_columns(probe.got["two"][0], ("x",))["x"], COLUMNS["x"])


def test_a_topic_that_no_stage_publishes_comes_from_outside(probe):
    pipeline, executor = Pipeline(), SingleThreadedExecutor(context=probe.context)
    node = Relay(pipeline, "alone", "outside", context=probe.context)
    assert node.port.outside is None  # others may come that publish it
    pipeline.open()
    executor.add_node(node)
    out = probe.speak("outside")
    work(probe, executor, lambda: out.get_subscription_count() == 1)
    out.publish(keypoint_cloud(7))
    work(probe, executor, lambda: node.heard)
    assert stamp_of(node.heard[0]) == 7 and node.heard[0].width == 15
    node.destroy_node()


@pytest.fixture
def resting(line):
    """The same relays, which rest while nobody needs their answers; the third may be busy by itself."""
    line[2].is_busy, line[0].turns = False, []
    for node in line:
        turned = partial(line[0].turns.append, node.get_name())
        node.stage.rest_unheard(Skips(), turned, lambda node=node: getattr(node, "is_busy", False))
    line[0].stage.pipeline.look_again()
    return line


def needed(line):
    return [node.stage.is_needed for node in line]


@pytest.mark.parametrize(("topic", "wanted"), [("one", 1), ("two", 2), ("three", 3)])
def test_the_stages_before_a_topic_that_somebody_hears_are_awake_and_those_behind_it_rest(
    resting, probe, topic, wanted
):
    first, second, third = resting
    assert needed(resting) == [False] * 3
    first.say(COLUMNS)
    assert not second.heard and not first.out.get_subscription_count()
    listener = probe.hear(topic, PointCloud2)
    first.work(lambda: needed(resting) == [number < wanted for number in range(3)])
    first.say(COLUMNS)
    first.work(lambda: probe.got[topic])
    assert len(second.heard) == (wanted > 1) and len(third.heard) == (wanted > 2)
    assert first.out.get_subscription_count() == 1 and first.turns.count("first") == 2
    probe.destroy_subscription(listener)
    first.work(lambda: not any(needed(resting)))


def test_a_stage_that_is_busy_keeps_those_before_it_awake(resting):
    first, _, third = resting
    third.is_busy = True
    first.work(lambda: all(needed(resting)))
    first.say(COLUMNS)
    assert third.heard
    third.is_busy = False
    first.work(lambda: not any(needed(resting)))


def test_a_process_at_rest_looks_for_listeners_more_rarely(resting):
    pipeline, third = resting[0].stage.pipeline, resting[2]
    assert pipeline._looking.timer_period_ns == round(1e9 * topics._AT_REST)
    third.is_busy = True
    resting[0].work(lambda: all(needed(resting)))
    assert pipeline._looking.timer_period_ns == round(1e9 * topics._LOOKED_FOR)


def test_who_listens_to_diagnostics_alone_wakes_nobody(resting, probe):
    resting[0].work(lambda: len(probe.got["/diagnostics"]) > 6)
    assert probe.count_subscribers("/diagnostics") == 1 and not any(needed(resting))


def test_a_stage_that_rests_hears_nothing_from_outside_until_somebody_hears_it(probe, monkeypatch):
    monkeypatch.setattr(topics, "_AT_REST", 1000.0)  # it is the listener that wakes it
    pipeline, executor = Pipeline(), SingleThreadedExecutor(context=probe.context)
    node = Relay(pipeline, "alone", "outside", "said", context=probe.context)
    node.stage.rest_unheard(Skips(), lambda: None)
    pipeline.open()
    executor.add_node(node)
    pipeline.look_again()  # after which the next is far
    assert node.port.outside is None
    probe.hear("said", PointCloud2)
    work(probe, executor, lambda: node.port.outside is not None)
    node.destroy_node()


def test_stages_that_hear_each_other_rest_all_the_same(probe):
    pipeline = Pipeline()
    pair = [Relay(pipeline, *words, context=probe.context) for words in (("a", "one", "two"), ("b", "two", "one"))]
    for node in pair:
        node.stage.rest_unheard(Skips(), lambda: None)
    pipeline.open()
    assert needed(pair) == [False, False]
    pair[0].stage.keep_awake(60.0)
    assert needed(pair) == [True, True]
    for node in pair:
        node.destroy_node()


def test_without_the_rule_no_stage_rests(probe):
    pipeline = Pipeline()
    node = Relay(pipeline, "alone", "outside", "said", context=probe.context)
    node.stage.rest_unheard(Skips([UNHEARD]), lambda: None)
    pipeline.open()
    assert node.stage.is_needed and node.port.outside is not None
    node.destroy_node()


def test_a_fault_stops_one_stage_and_says_so_while_the_others_go_on(line, probe):
    first, second, third = line
    second.fails = True
    first.say(COLUMNS)
    second.fails = False
    first.say(COLUMNS)
    assert not second.heard and not third.heard and not third.stage.fault
    assert second.stage.fault == "ValueError: no way"

    def states(name):
        arrays = probe.got["/diagnostics"][-6:]
        return [s for array in arrays for s in array.status if s.name == name]

    first.work(lambda: any(s.level[0] == Level.ERROR for s in states("second")))
    assert "stopped by ValueError: no way" in states("second")[-1].message
    first.work(lambda: states("third") and states("third")[-1].level[0] == Level.OK)


def test_a_service_that_fails_stops_its_stage_and_answers(line, probe):
    first, second, _ = line
    client = probe.create_client(Trigger, "second/ask")
    first.work(client.service_is_ready)
    second.fails = True
    answer = client.call_async(Trigger.Request())
    first.work(answer.done)
    assert not answer.result().success and "no answer" in answer.result().message
    assert second.stage.fault and not first.stage.fault


def test_nobody_waits_for_a_stage_that_takes_longer_than_its_budget(probe, monkeypatch):
    monkeypatch.setattr(topics, "WATCHED", 3)
    pipeline, order = Pipeline(), []
    source = Relay(pipeline, "source", "", "one", context=probe.context)
    slow = Relay(pipeline, "slow", "one", context=probe.context)
    slow.port.can_wait = True
    quick = Relay(pipeline, "quick", "one", context=probe.context)
    for node in (slow, quick):
        node.port.callback = partial(lambda name, message: order.append(name), node.get_name())
    pipeline.open()
    say = pipeline.turn(lambda _: source.say(COLUMNS))
    say(None)
    assert order == ["slow", "quick"]
    slow.port._times.extend([2.0 * topics.BUDGET] * 3)
    say(None)
    assert order[2:] == ["quick", "slow"]  # after the others, and with its own image
    for _ in range(3):
        slow.port._times.append(0.0)
    say(None)
    assert order[4:] == ["slow", "quick"]
    for node in (source, slow, quick):
        node.destroy_node()


def test_what_no_force_waits_for_is_done_once_the_outermost_callback_has_returned(line):
    first, second, _ = line
    pipeline, order = first.stage.pipeline, []

    def take(_):
        second.stage.afterwards(lambda: order.append("later"))
        order.append("now")

    pipeline.turn(take)(None)
    assert order == ["now", "later"]
    second.stage.afterwards(lambda: order.append("at once"))  # nobody is at work
    assert order[2:] == ["at once"]


def test_a_solver_in_a_pipeline_solves_what_it_is_handed(probe):
    pipeline = Pipeline()
    source = Relay(pipeline, "source", "", "left/keypoints", context=probe.context)
    overrides = [Parameter("contact_height", value=0.04), Parameter("max_age", value=60.0)]
    estimator = FakeEstimator()
    solver = IfeaSolverNode(
        lambda *_: estimator, pipeline=pipeline, context=probe.context, parameter_overrides=overrides
    )
    pipeline.open()
    stamp = solver.get_clock().now().to_msg()
    cloud = keypoint_cloud()
    columns = decode_columns(cloud, ("x", "y", "z", "likelihood"))
    pipeline.turn(lambda _: ros.send_cloud(source.out, Header(stamp=stamp, frame_id="left_jaw"), columns))(None)
    assert len(estimator.observations) == 1 and estimator.learnt == 1
    packed = decode_columns(ros.cloud_message(cloud.header, columns), ("x", "y", "z"))
    np.testing.assert_array_equal(
        estimator.observations[0].points, np.stack([packed[axis] for axis in "xyz"], axis=1).astype(float)
    )
    for node in (source, solver):
        node.destroy_node()


def test_columns_that_were_not_packed_read_as_a_cloud_does():
    columns = {"x": np.arange(2, dtype=np.float32), "n": np.array([3, 4], np.uint16)}
    cloud = CloudColumns(Header(), columns)
    packed = ros.pack(cloud)
    assert [field.name for field in cloud.fields] == [field.name for field in packed.fields]
    for names in (("x",), ("n", "x")):
        here, there = decode_columns(cloud, names, ("n",)), decode_columns(packed, names, ("n",))
        assert here.keys() == there.keys() and all((here[name] == there[name]).all() for name in here)
    empty = CloudColumns(Header(), {"x": np.empty(0, np.float32)})
    assert empty.width == 0 and decode_columns(empty, ("x", "y"))["y"].size == 0
    with pytest.raises(ObservationError, match="no field y"):
        decode_columns(cloud, ("y",))
    assert ros.pack(text := String(data="as it is")) is text


@pytest.mark.parametrize("word", ["", "[]", "keypoint_detector", '["recording_player"]', '["ifea_solver", 3]', "{}"])
def test_a_word_that_asks_for_no_stage_is_refused(word):
    with pytest.raises(ros.ParameterError, match="expected a JSON list"):
        read_part(word)


def run_pipeline(*parts):
    words = [sys.executable, "-m", "finforce.ros.start", "finforce_pipeline", *map(json.dumps, parts), "--ros-args"]
    return subprocess.run(words, capture_output=True, text=True, timeout=120, env=environment())


def test_a_stage_that_cannot_be_built_ends_the_process_with_one_line():
    done = run_pipeline(["ifea_solver", "-p", "jaw_file:=nowhere.yaml"])
    assert done.returncode == 2 and "nowhere.yaml" in done.stderr and "Traceback" not in done.stderr
    done = run_pipeline(["nobody"])
    assert done.returncode == 2 and "nobody" in done.stderr
