"""Claims about the executor of all nodes: it works as rclpy's does, without its look through all entities."""

import asyncio
from time import monotonic

import pytest
from node_fakes import PATIENCE, ros_domain
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.task import Future
from std_msgs.msg import String
from std_srvs.srv import Trigger

from finforce.ros.executor import TolerantExecutor


class Talk:
    """A node that tells itself something whenever it heard it, and the executor that it works in."""

    def __init__(self, context):
        self.node, self.executor = Node("talk", context=context), TolerantExecutor(context=context)
        self.heard, self.looks, self.publisher = [], 0, self.node.create_publisher(String, "talk", 1)
        self.reader = self.node.create_subscription(String, "talk", self.hear, 1)
        self.executor.add_node(self.node)
        gather = self.executor._wait_for_ready_callbacks

        def count(*args, **options):
            self.looks += 1
            return gather(*args, **options)

        self.executor._wait_for_ready_callbacks = count
        self.start()

    def start(self):
        """Say the first word once it can be heard."""
        end = monotonic() + PATIENCE
        while self.publisher.get_subscription_count() == 0:
            assert monotonic() < end
        self.publisher.publish(String(data="0"))

    def hear(self, message):
        self.heard.append(message.data)
        if self.node.context.ok():
            self.publisher.publish(String(data=str(len(self.heard))))

    def work(self, is_done):
        end = monotonic() + PATIENCE
        while not is_done():
            assert monotonic() < end, f"heard {len(self.heard)}"
            self.executor.spin_once(timeout_sec=0.5)

    def hear_more(self, count):
        end = len(self.heard) + count
        self.work(lambda: len(self.heard) >= end)


@pytest.fixture
def talk():
    with ros_domain() as probe:
        talk = Talk(probe.context)
        yield talk
        talk.node.destroy_node()


def test_messages_are_taken_in_order_and_rclpy_looks_at_few(talk):
    talk.work(lambda: len(talk.heard) >= 200)
    assert talk.heard == [str(number) for number in range(len(talk.heard))]
    assert 0 < talk.looks < 0.5 * len(talk.heard)


def test_timers_run_while_messages_come(talk):
    ticks = []
    talk.work(lambda: len(talk.heard) >= 10)
    timer = talk.node.create_timer(0.01, lambda: ticks.append(len(talk.heard)))
    talk.work(lambda: len(ticks) >= 20)
    assert ticks == sorted(ticks) and ticks[0] < ticks[-1]
    timer.cancel()
    count = len(ticks)
    talk.hear_more(100)
    assert len(ticks) == count


def test_what_comes_and_goes_while_messages_come_is_heard_and_then_not(talk):
    other = []
    talk.work(lambda: len(talk.heard) >= 10)
    reader = talk.node.create_subscription(String, "talk", other.append, 1)
    talk.work(lambda: len(other) >= 5)
    talk.node.destroy_subscription(reader)
    count = len(other)
    talk.hear_more(50)
    assert len(other) == count


def test_a_service_is_answered_while_messages_come_and_one_who_awaits_keeps_its_group_alone(talk):
    own, beside, answer = MutuallyExclusiveCallbackGroup(), [], Future()

    async def wait(_, response):
        response.message = await answer
        return response

    talk.node.create_service(Trigger, "wait", wait, callback_group=own)
    talk.node.create_subscription(String, "talk", beside.append, 1, callback_group=own)
    client = talk.node.create_client(Trigger, "wait")
    talk.work(client.service_is_ready)
    talk.work(lambda: len(beside) >= 3)
    asked = client.call_async(Trigger.Request())
    talk.work(lambda: any(not task.done() for task, *_ in talk.executor._tasks))
    count, looks = len(beside), talk.looks
    talk.hear_more(100)
    assert len(beside) == count and not asked.done() and talk.looks - looks < 50
    answer.set_result("done")
    talk.executor.wake()
    talk.work(asked.done)
    assert asked.result().message == "done"
    talk.work(lambda: len(beside) > count)


def test_a_callback_may_be_a_coroutine(talk):
    found = []

    async def hear(message):
        await asyncio.sleep(0)
        found.append(message.data)

    talk.work(lambda: len(talk.heard) >= 10)
    talk.node.create_subscription(String, "talk", hear, 1)
    talk.work(lambda: len(found) >= 3)


def test_events_are_heard_while_messages_come(talk):
    talk.work(lambda: len(talk.heard) >= 10)
    met = []
    for handler in talk.publisher.event_handlers:
        handler.callback = met.append
    listener = Node("listener", context=talk.node.context)
    listener.create_subscription(
        String, "talk", met.append, QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    )
    talk.work(lambda: len(met) >= 1)
    listener.destroy_node()


def test_a_failing_callback_ends_the_work(talk):
    def fail(_):
        raise ZeroDivisionError

    talk.work(lambda: len(talk.heard) >= 10)
    talk.node.create_subscription(String, "talk", fail, 1)
    with pytest.raises(ZeroDivisionError):
        talk.work(lambda: False)


def test_it_ends_with_its_context(talk):
    talk.work(lambda: len(talk.heard) >= 10)
    talk.node.create_timer(0.02, talk.node.context.shutdown)
    with pytest.raises(ExternalShutdownException):
        talk.work(lambda: False)
