import pytest
from emulator_fakes import VARIANTS
from emulator_faults import FaultKind, FaultyAdapter, PlannedFault, draw_plan

from finforce_driver.can.protocol import CanMessage
from finforce_sim.emulator.firmware import EmulatedGripper, Fault

REPLY = b"t078400000030\r"
POLL = b"t07A0\r"


class FaultyHost:
    def __init__(self, variant="new", plan=(), seed=0):
        self.faulty = FaultyAdapter(EmulatedGripper(variant), plan, seed, latency=0.0)
        self.open()

    @property
    def gripper(self):
        return self.faulty.gripper

    def open(self):
        self.faulty.write(b"C\rS8\rO\r")

    def say(self, data, milliseconds=1):
        """Return what comes back within some time."""
        self.faulty.write(data)
        answer = b""
        for _ in range(milliseconds):
            self.faulty.step(0.001)
            answer += self.faulty.read()
        return answer


@pytest.fixture(params=VARIANTS)
def host(request):
    return FaultyHost(request.param)


def test_every_kind_is_either_of_lines_or_happens(host):
    for kind in FaultKind:
        host.faulty.inject(kind)
    assert [fault.kind for fault in host.faulty.injected] == list(FaultKind)
    host.faulty.heal()


@pytest.mark.parametrize(
    ("kind", "answer"),
    [
        (FaultKind.LOST, b""),
        (FaultKind.DOUBLED, REPLY * 2),
        (FaultKind.BELL, b"\a" + REPLY),
        (FaultKind.HEARTBEAT, b"t0120\r" + REPLY),
        (FaultKind.SPLIT, REPLY),
        (FaultKind.REQUEST_LOST, b""),
    ],
)
def test_line_faults_do_what_their_name_says_and_end(host, kind, answer):
    host.faulty.inject(kind, count=2)
    assert [host.say(POLL, 30) for _ in range(3)] == [answer, answer, REPLY]


def test_late_lines_arrive_in_order(host):
    host.gripper.step()
    host.faulty.inject(FaultKind.LATE)
    assert host.say(POLL, 4) == b""
    host.gripper.protection.faults.add(Fault.WATCHDOG)
    assert host.say(POLL, 130) == REPLY + b"t079400000034\r"


def test_garbage_holds_bytes_that_are_no_ascii(host):
    host.faulty.inject(FaultKind.GARBAGE, count=20)
    for _ in range(20):
        answer = host.say(POLL)
        assert b"\xff" in answer and answer.endswith(REPLY)


def test_truncated_lines_are_no_replies(host):
    host.faulty.inject(FaultKind.TRUNCATED, count=20)
    for _ in range(20):
        answer = host.say(POLL)
        assert 1 <= len(answer.rstrip(b"\r")) < len(REPLY) - 1 and REPLY.startswith(answer.rstrip(b"\r"))


def test_wrong_length_is_a_sound_line(host):
    host.faulty.inject(FaultKind.WRONG_LENGTH, count=20)
    for _ in range(20):
        answer = host.say(POLL)
        assert answer != REPLY and len(answer) == 6 + 2 * int(answer[4:5])


def test_foreign_replies_have_another_node(host):
    host.faulty.inject(FaultKind.FOREIGN, count=20)
    for _ in range(20):
        foreign, own, end = host.say(POLL).split(b"\r")
        assert own + b"\r" == REPLY and end == b""
        assert int(foreign[1:4], 16) >> 7 != 0 and int(foreign[1:4], 16) & 0x7F == 0x78


def test_flipped_lines_differ_in_one_digit(host):
    host.faulty.inject(FaultKind.FLIPPED, count=50)
    for _ in range(50):
        answer = host.say(POLL)
        assert sum(one != other for one, other in zip(answer, REPLY, strict=True)) == 1
        assert answer[:1] == b"t" and answer[1:-1].isalnum()


def test_stale_code_and_blip_touch_the_object_code_only_for_a_while(host):
    host.say(b"t07A50000012C80\r", 2)
    host.gripper._control.object_code = 0
    host.faulty.inject(FaultKind.STALE_CODE)
    assert host.say(POLL) == b"t0784000000B0\r" and host.say(POLL) == b"t078400000080\r"
    host.faulty.inject(FaultKind.BLIP)
    assert int(host.say(POLL)[11:13], 16) & 0x30 in (0x10, 0x20)
    assert host.say(b"", 10) == b"" and host.say(POLL) == b"t078400000080\r"


@pytest.mark.parametrize(
    ("kind", "fault"),
    [
        (FaultKind.OVERHEATED, Fault.TEMPERATURE),
        (FaultKind.SUPPLY, Fault.SUPPLY),
        (FaultKind.ENCODER, Fault.ENCODER),
        (FaultKind.WATCHDOG, Fault.WATCHDOG),
    ],
)
def test_faults_of_the_gripper_are_latched_and_can_be_cleared_when_over(host, kind, fault):
    host.faulty.inject(kind, duration=0.1)
    host.say(b"", 2)
    assert host.gripper.faults == {fault}
    host.say(b"", 110)
    host.say(b"t0020\r", 2)
    assert host.gripper.faults == set()


def test_same_fault_twice_lasts_longer_and_ends_sound(host):
    host.faulty.inject(FaultKind.SUPPLY, duration=0.1)
    host.say(b"", 50)
    host.faulty.inject(FaultKind.SUPPLY, duration=0.1)
    host.say(b"", 60)
    assert host.gripper.protection.voltage < 9.0
    host.say(b"", 60)
    assert host.gripper.protection.voltage == 24.0


def test_healing_ends_everything_at_once(host):
    for kind in FaultKind:
        host.faulty.inject(kind, count=3, duration=100.0)
    host.faulty.heal()
    host.gripper.reboot()
    host.say(b"", 400)
    host.open()
    assert host.say(POLL) == REPLY and host.gripper.configured and not host.gripper.jaws.slips


def test_unplugging_ends_after_its_time_with_a_closed_adapter(host):
    host.faulty.inject(FaultKind.UNPLUGGED, duration=0.1)
    assert not host.faulty.plugged and host.say(POLL, 99) == b""
    host.say(b"", 2)
    assert host.faulty.plugged and host.say(POLL) == b""
    host.open()
    assert host.say(POLL) == REPLY


def test_other_master_is_seen_on_the_bus(host):
    seen = set()
    for _ in range(40):
        host.faulty.inject(FaultKind.OTHER_MASTER)
        seen.add(host.say(b"")[1:4])
    assert seen >= {b"07A", b"000", b"002", b"018"}


def test_plans_are_the_same_for_the_same_seed_and_spread_over_time():
    plan = draw_plan(3, 200, 0.5)
    assert plan == draw_plan(3, 200, 0.5) != draw_plan(4, 200, 0.5)
    assert all(0.5 * index <= fault.time < 0.5 * (index + 1) for index, fault in enumerate(plan))
    assert {fault.kind for fault in plan} == set(FaultKind)


def test_runs_of_a_plan_are_the_same_to_the_byte():
    plan = draw_plan(5, 60, 0.1)

    def record(seed):
        host = FaultyHost(plan=plan, seed=seed)
        return [host.say(POLL, 20) for _ in range(300)]

    assert record(1) == record(1) != record(2)


def test_planned_faults_happen_at_their_time():
    host = FaultyHost(plan=[PlannedFault(time=0.05, kind=FaultKind.REBOOT)])
    host.say(b"", 48)
    assert not host.gripper.booting
    host.say(b"", 3)
    assert host.gripper.booting


def test_foreign_messages_of_the_bus_pass_without_spoiling_acknowledgements():
    faulty = FaultyAdapter(EmulatedGripper(), ack_mode="lawicel", latency=0.0)
    faulty.write(b"S8\rO\r")
    faulty.inject(FaultKind.LOST)
    faulty.write(POLL)
    faulty.step(0.001)
    assert faulty.read() == b"\r\rz\r"
    faulty.deliver(CanMessage(id=0x155))
    assert faulty.read() == b"t1550\r"
