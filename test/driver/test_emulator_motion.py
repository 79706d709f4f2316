import pytest
from emulator_fakes import CLEAR, IDLE, VARIANTS, Host, calibrated_host, code_of, current_of

CONTACT = {("new", "closing"): 0x20, ("new", "opening"): 0x10, ("old", "closing"): 0x10, ("old", "opening"): 0x20}
AT_POSITION = 0x30
TICK = 0.048 / 10558  # [m]


@pytest.mark.parametrize("position", [0, 1, 50, 100, 128, 254, 255])
def test_target_is_reached_and_reported_one_count_less(variant, position):
    host = calibrated_host(variant)
    host.order(position, 255)
    host.wait(0.5)
    reply = host.poll()
    assert code_of(reply) == AT_POSITION
    assert position - 1 <= reply[0] <= position
    if variant == "new" and 0 < position < 255:
        assert reply[0] == position - 1
    assert host.gripper.jaws.opening == pytest.approx(0.048 * (255 - position) / 255, abs=2 * TICK)  # truncation


@pytest.mark.parametrize(("speed", "ticks_per_second"), [(3, 980), (30, 9447), (100, 31396)])
def test_speed_is_that_of_the_byte(variant, speed, ticks_per_second):
    host = calibrated_host(variant)
    host.order(255, speed)
    host.wait(0.1)
    assert 10329 - host.gripper.jaws.encoder == pytest.approx(0.1 * ticks_per_second, abs=1.5)  # whole ticks, one step
    assert code_of(host.poll()) == 0


@pytest.mark.parametrize(("limit", "free"), [(1000, 60), (200, 40)])
def test_free_jaws_need_little_current(variant, limit, free):
    host = calibrated_host(variant)
    host.order(255, 10, limit)
    host.wait(0.5)
    assert current_of(host.poll()) == pytest.approx(-free, abs=1)
    host.order(0, 10, limit)
    host.wait(0.2)
    assert current_of(host.poll()) == pytest.approx(free, abs=1)


def test_rigid_object_stops_the_jaws_and_the_current_tells_the_direction(variant):
    host = calibrated_host(variant, object_opening=0.02)
    host.order(255, 50, 500)
    host.wait(1.0)
    reply = host.poll()
    assert code_of(reply) == CONTACT[variant, "closing"]
    assert current_of(reply) == pytest.approx(-500, abs=1)
    assert host.gripper.jaws.opening == pytest.approx(0.02, abs=1e-12)


def test_wall_outside_stops_opening_jaws(variant):
    host = calibrated_host(variant)
    host.order(255, 255)
    host.wait(0.5)
    host.gripper.jaws.wall_opening = 0.03
    host.order(0, 50, 500)
    host.wait(1.0)
    reply = host.poll()
    assert code_of(reply) == CONTACT[variant, "opening"]
    assert current_of(reply) == pytest.approx(500, abs=1)
    assert host.gripper.jaws.opening == pytest.approx(0.03, abs=1e-12)


def test_contact_shows_only_once_the_current_has_risen():
    host = calibrated_host(object_opening=0.0479)
    host.order(255, 50, 500)
    host.wait(0.010)
    assert code_of(host.poll()) == 0
    host.wait(0.035)  # 80 % of the limit after 32 ms at a lag of 20 ms
    assert code_of(host.poll()) == CONTACT["new", "closing"]


@pytest.mark.parametrize("current", [200, 500, 1000])
def test_spring_is_pressed_as_far_as_the_current_allows(variant, current):
    host = calibrated_host(variant, load=lambda opening: 2000.0 * max(0.045 - opening, 0.0))
    host.order(255, 50, current)
    host.wait(2.0)
    force = 0.0477 * current
    assert host.gripper.jaws.force == pytest.approx(force, rel=1e-5)
    assert host.gripper.jaws.opening == pytest.approx(0.045 - force / 2000.0, abs=1e-7)
    assert current_of(host.poll()) == pytest.approx(-current, abs=1)
    assert code_of(host.poll()) == CONTACT[variant, "closing"]


def test_at_a_position_the_current_holds_the_load():
    host = calibrated_host(load=lambda opening: 1000.0 * max(0.03 - opening, 0.0))
    host.order(128, 50, 500)
    host.wait(1.0)
    assert code_of(host.poll()) == AT_POSITION
    assert current_of(host.poll()) == pytest.approx(-1000.0 * host.gripper.jaws.force / 47.7, abs=1)


def test_weaker_limit_lets_the_load_open_the_jaws():
    host = calibrated_host(load=lambda opening: 1000.0 * max(0.04 - opening, 0.0))
    host.order(160, 50, 1000)
    host.wait(1.0)
    assert host.gripper.jaws.force > 15.0
    host.order(160, 50, 200)
    host.wait(1.0)
    assert host.gripper.jaws.force == pytest.approx(9.54, rel=1e-4)


def test_relaxing_load_lets_the_jaws_creep_on():
    weight = [1.0]
    host = calibrated_host(load=lambda opening: weight[0] * 1000.0 * max(0.04 - opening, 0.0))
    host.order(255, 50, 300)
    host.wait(1.0)
    before = host.gripper.jaws.opening
    weight[0] = 0.9
    host.wait(0.5)
    assert host.gripper.jaws.force == pytest.approx(14.31, rel=1e-4)
    assert before - host.gripper.jaws.opening == pytest.approx(0.01431 * (1 / 0.9 - 1), rel=1e-3)


@pytest.mark.parametrize("stop", ["idle", "deactivate", "inactive action"])
def test_without_power_the_load_opens_the_jaws(variant, stop):
    host = calibrated_host(variant, load=lambda opening: 1000.0 * max(0.03 - opening, 0.0))
    host.order(200, 50, 500)
    host.wait(1.0)
    if stop == "idle":
        host.tell(IDLE)
    else:
        host.order(200, 50, 500, 0x00 if stop == "deactivate" else 0x80)
    host.wait(1.0)
    assert host.gripper.jaws.force == pytest.approx(0.0, abs=1e-6)
    assert host.gripper.jaws.opening == pytest.approx(0.03, abs=1e-6)


def test_new_firmware_forgets_the_object_code_without_action_and_old_keeps_it():
    codes = {}
    for variant in VARIANTS:
        host = calibrated_host(variant)
        assert code_of(host.poll()) == AT_POSITION
        host.order(0, 255, 500, 0x80)
        codes[variant] = code_of(host.poll())
    assert codes == {"new": 0, "old": AT_POSITION}


def test_nothing_moves_before_calibration(variant):
    host = Host(variant)
    host.order(255, 255)
    host.wait(0.5)
    assert host.gripper.jaws.opening == pytest.approx(0.048, abs=1e-12)


@pytest.mark.parametrize("current", [0, -500])
def test_currents_that_are_no_limits_move_nothing_and_are_noted(current):
    host = calibrated_host()
    host.order(255, 50, current)
    host.wait(0.5)
    assert host.gripper.jaws.opening == pytest.approx(0.048, abs=1e-12)
    assert host.gripper.violations["current out of range"] == 1


def test_same_order_after_an_interruption_is_not_slow_any_more(variant):
    host = calibrated_host(variant)
    host.order(200, 3)
    host.wait(10.0)
    assert code_of(host.poll()) == AT_POSITION
    host.tell(IDLE)
    host.gripper.jaws.ticks = 9000.0  # moved by hand
    host.order(200, 3)
    host.wait(0.1)
    assert host.gripper.jaws.opening == pytest.approx(0.048 * 55 / 255, abs=0.2e-3)
    assert host.gripper.violations["stale latch"] == 1


def test_an_ignored_bit_makes_it_slow_again(variant):
    host = calibrated_host(variant)
    host.order(200, 3)
    host.wait(10.0)
    host.tell(CLEAR)
    host.gripper.jaws.ticks = 9000.0
    host.order(200, 3, flags=0xC1)
    host.wait(0.1)
    assert host.gripper.jaws.ticks == pytest.approx(9000 - 98, abs=3)
    assert "stale latch" not in host.gripper.violations


def test_slowest_speeds_feel_contact_while_the_jaws_still_move():
    openings = {}
    for speed in (2, 3):
        host = calibrated_host(load=lambda opening: 500.0 * max(0.048 - opening, 0.0) + 8.0)
        host.order(255, speed, 200)
        host.wait(0.5)
        seen = set()
        for _ in range(20):
            before = host.gripper.jaws.ticks
            seen.add((code_of(host.poll()), host.gripper.jaws.ticks < before))
        openings[speed] = (CONTACT["new", "closing"], True) in seen
    assert openings == {2: True, 3: False}


def test_time_goes_in_whole_steps_however_it_is_cut():
    pieces, whole = calibrated_host(), calibrated_host()
    for host in (pieces, whole):
        host.order(255, 10)
    for _ in range(1000):
        pieces.gripper.step(0.0003)
    whole.gripper.step(0.3)
    assert pieces.gripper.jaws.ticks == whole.gripper.jaws.ticks
