"""Claims about the executor that keeps its wait set: nothing is lost, whatever comes and goes."""

from time import monotonic, sleep
from types import SimpleNamespace

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import String
from std_srvs.srv import Trigger

from finforce.ros import executor as executor_module
from finforce.ros import node as ros
from finforce.ros.executor import KeepingExecutor, is_wanted
from finforce.skipping import ALL, UNCHANGED, UNHEARD, Skips

PATIENCE = 10.0


class Worker(Node):
    """Counts what it hears, on a timer too, and has a service and a coroutine."""

    def __init__(self, *off, **options):
        super().__init__("worker", **options)
        self.skips, self.heard, self.ticks, self.slept = Skips((), off), [], 0, 0
        self.spare = 0.0
        self.plain = self.create_subscription(String, "plain", lambda message: self.heard.append(message.data), 10)
        self.create_subscription(String, "slow", self.think, 10)
        self.create_timer(0.02, self.tick)
        ros.serve_trigger(ros.QosWatch(self), "ask", lambda: "answer")

    async def think(self, message):
        self.heard.append(await ros.run_aside(self, lambda: message.data.upper()))

    def tick(self):
        self.ticks += 1

    def spare_time(self):
        self.slept += self.spare > 0.0
        return self.spare


@pytest.fixture(params=[(), (ALL,)], ids=["kept", "not kept"])
def working(request, probe):
    """A worker with its executor, as `run_node` puts them together."""
    worker, executor = Worker(*request.param, context=probe.context), KeepingExecutor(context=probe.context)
    executor.obey([worker])
    executor.add_node(worker)
    yield worker, executor
    executor.remove_node(worker)
    worker.destroy_node()


def work(probe, working, condition):
    """Let the worker work until a condition holds; its timer wakes it."""
    until = monotonic() + PATIENCE
    while not condition():
        assert monotonic() < until, working[0].heard
        working[1].spin_once()
        probe.spinner.spin_once(timeout_sec=0.0)


def test_messages_timers_services_and_coroutines_are_all_answered(probe, working):
    worker, _ = working
    out, slow = (probe.speak(topic, String) for topic in ("plain", "slow"))
    client = probe.create_client(Trigger, "ask")
    work(probe, working, lambda: out.get_subscription_count() and slow.get_subscription_count())
    work(probe, working, client.service_is_ready)
    future = client.call_async(Trigger.Request())
    for number in range(5):
        out.publish(String(data=str(number)))
    slow.publish(String(data="word"))
    work(probe, working, lambda: future.done() and len(worker.heard) == 6 and worker.ticks > 3)
    assert [word for word in worker.heard if word != "WORD"] == list("01234")
    assert future.result().message == "answer"
    # after a coroutine the wait set is kept again
    out.publish(String(data="5"))
    work(probe, working, lambda: "5" in worker.heard)
    said = worker.skips.describe()[f"skipped: {UNCHANGED}"]
    assert said == ("6" if worker.skips.allows(UNCHANGED) else "off")


def test_what_comes_later_is_heard_and_what_went_is_not(probe, working):
    worker, _ = working
    plain, late = (probe.speak(topic, String) for topic in ("plain", "late"))
    work(probe, working, plain.get_subscription_count)
    plain.publish(String(data="first"))
    work(probe, working, lambda: worker.heard)
    worker.heard.clear()
    worker.destroy_subscription(worker.plain)
    worker.create_subscription(String, "late", lambda message: worker.heard.append(message.data), 10)
    work(probe, working, lambda: late.get_subscription_count() and not plain.get_subscription_count())
    plain.publish(String(data="gone"))
    for count in range(1, 9):
        late.publish(String(data="here"))
        work(probe, working, lambda count=count: len(worker.heard) == count)
    assert worker.heard == ["here"] * 8
    # most of them by the wait set that was kept, since the timer seldom comes between
    said = worker.skips.describe()[f"skipped: {UNCHANGED}"]
    assert said == "off" or int(said) > 3


def test_messages_wait_while_the_node_has_time_to_spare(probe, working):
    worker, _ = working
    out = probe.speak("plain", String)
    work(probe, working, out.get_subscription_count)
    worker.spare = 0.05
    for number in range(4):
        out.publish(String(data=str(number)))
    work(probe, working, lambda: len(worker.heard) == 4)
    assert worker.heard == list("0123")
    assert bool(worker.slept) is worker.skips.allows(UNCHANGED)


class Gate(MutuallyExclusiveCallbackGroup):
    """A group that lets messages wait."""

    is_open = False

    def can_execute(self, entity):
        return self.is_open and super().can_execute(entity)


def test_what_a_group_lets_wait_wakes_nobody_and_is_not_lost(probe, working):
    worker, executor = working
    gate = Gate()
    worker.create_subscription(
        String, "gated", lambda message: worker.heard.append(message.data), 10, callback_group=gate
    )
    out = probe.speak("gated", String)
    work(probe, working, out.get_subscription_count)
    out.publish(String(data="late"))
    before, turns = worker.ticks, 0
    while worker.ticks < before + 10:
        executor.spin_once()
        turns += 1
    assert turns <= 20 and not worker.heard
    gate.is_open = True
    work(probe, working, lambda: worker.heard)
    assert worker.heard == ["late"]


def test_timers_go_on_until_they_are_taken_away(probe, working):
    worker, _ = working
    once = worker.create_timer(0.01, lambda: (worker.heard.append("once"), worker.destroy_timer(once)))
    off = worker.create_timer(0.01, lambda: worker.heard.append("never"))
    off.cancel()
    before = worker.ticks
    work(probe, working, lambda: worker.ticks >= before + 20 and worker.heard)
    assert worker.heard == ["once"]


@pytest.mark.parametrize(
    "stop", [lambda worker, timer: timer.cancel(), lambda worker, timer: worker.destroy_timer(timer)]
)
def test_of_two_timers_that_are_due_the_first_may_stop_the_second(probe, working, stop):
    worker, _ = working
    timers = {}

    def call(name, other):
        worker.heard.append(name)
        if other in timers:
            stop(worker, timers.pop(other))

    timers["a"] = worker.create_timer(0.01, lambda: call("a", "b"))
    timers["b"] = worker.create_timer(0.01, lambda: call("b", "a"))
    sleep(0.05)
    work(probe, working, lambda: len(worker.heard) >= 3)
    assert len(set(worker.heard)) == 1


def test_a_handle_that_a_callback_has_destroyed_is_its_own_fault(probe, working):
    worker, executor = working
    out = worker.create_publisher(String, "gone", 10)
    worker.destroy_publisher(out)
    worker.create_timer(0.01, lambda: out.publish(String()))
    with pytest.raises(InvalidHandle):
        work(probe, working, lambda: False)


def test_a_connection_that_does_not_come_about_is_noticed(probe, working):
    worker, _ = working
    reliable = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
    events = SubscriptionEventCallbacks(incompatible_qos=lambda event: worker.heard.append(event.total_count))
    worker.create_subscription(String, "lossy", lambda message: None, reliable, event_callbacks=events)
    probe.create_publisher(String, "lossy", QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    work(probe, working, lambda: worker.heard)
    assert worker.heard == [1]


def test_large_messages_that_come_with_best_effort_are_taken_so(probe, working):
    worker, _ = working
    ros.LargeSubscription(ros.QosWatch(worker), String, "large", lambda message: worker.heard.append(message.data))
    out = probe.create_publisher(String, "large", QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))

    def heard():
        out.publish(String(data="large"))
        return len(worker.heard) >= 3

    work(probe, working, heard)
    assert set(worker.heard) == {"large"}


def test_a_topic_is_wanted_while_somebody_subscribes(probe):
    skips = Skips(())
    out = probe.create_publisher(DiagnosticArray, "shown", 10)
    assert not is_wanted(out, skips) and skips.describe()[f"skipped: {UNHEARD}"] == "1"
    assert is_wanted(out, Skips((), (UNHEARD,)))
    probe.hear("shown", DiagnosticArray)
    probe.connected(out)
    assert is_wanted(out, skips) and skips.describe()[f"skipped: {UNHEARD}"] == "1"


def rename_event_handler(monkeypatch):
    monkeypatch.delattr("rclpy.event_handler.EventHandler")


def rename_entities(monkeypatch):
    monkeypatch.setitem(executor_module.ADDERS, "subscriptions", "add_reader")


def change_wait_set(monkeypatch):
    monkeypatch.setattr(executor_module._KeptSet, "wait", lambda self: None)


@pytest.mark.parametrize("change", [rename_event_handler, rename_entities, change_wait_set])
def test_where_rclpy_is_another_one_all_are_answered_by_its_own_executor(probe, monkeypatch, change):
    worker, executor = Worker(context=probe.context), KeepingExecutor(context=probe.context)
    said = []
    monkeypatch.setattr(executor_module, "get_logger", lambda _: SimpleNamespace(warning=said.append))
    out = probe.speak("plain", String)
    executor.obey([worker])
    executor.add_node(worker)
    work(probe, (worker, executor), out.get_subscription_count)
    change(monkeypatch)
    executor._release()  # as when something came or went
    for number in range(5):
        out.publish(String(data=str(number)))
    work(probe, (worker, executor), lambda: len(worker.heard) == 5 and worker.ticks > 3)
    assert worker.heard == list("01234")
    assert len(said) == 1 and UNCHANGED in said[0]
    executor.remove_node(worker)
    worker.destroy_node()


def test_an_error_of_a_callback_is_none_of_rclpys(probe, monkeypatch):
    worker, executor = Worker(context=probe.context), KeepingExecutor(context=probe.context)
    worker.create_subscription(String, "wrong", lambda message: message.nothing, 10)
    out = probe.speak("wrong", String)
    executor.add_node(worker)
    work(probe, (worker, executor), out.get_subscription_count)
    out.publish(String())
    with pytest.raises(AttributeError, match="nothing"):
        work(probe, (worker, executor), lambda: False)
    assert not executor._is_strange
    executor.remove_node(worker)
    worker.destroy_node()
