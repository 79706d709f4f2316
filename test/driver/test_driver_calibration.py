"""Claims about the calibration: its course, its end, what cuts it short."""

import math

import pytest
from emulator_fakes import VARIANTS, Rig
from emulator_faults import FaultKind

from finforce_driver.can.protocol import Command
from finforce_driver.errors import GripperStateError
from finforce_driver.state import MoveOutcome, Phase

both_variants = pytest.mark.parametrize("variant", VARIANTS)
LIMP = (Phase.UNCALIBRATED, Phase.FAULT)


@pytest.fixture
def rig(variant):
    return Rig(variant, calibrated=False)


@both_variants
def test_an_uncalibrated_gripper_says_so_and_knows_no_opening(rig):
    assert "calibrate" in rig.state.message
    assert math.isnan(rig.state.opening) and not rig.state.calibrated


@both_variants
def test_nothing_is_sent_but_questions_before_anything_is_asked_for(rig):
    rig.live(5.0)
    assert all(message.remote or message.data == b"" for message in rig.sent())
    assert {message.id for message in rig.sent()} == {0x07A, 0x02E, 0x030, 0x034}


@both_variants
def test_a_calibration_finds_the_stops_and_ends_closed(rig):
    rig.gripper.calibrate()
    assert rig.state.phase is Phase.CALIBRATING
    state = rig.wait_for(Phase.READY)
    assert state.calibrated
    assert state.opening == pytest.approx(0.0, abs=1e-4)
    assert rig.emulated.jaws.opening == pytest.approx(0.0, abs=1e-4)
    assert rig.arrive(0.02).outcome is MoveOutcome.REACHED


@both_variants
def test_during_a_calibration_only_empty_polls_and_questions_are_sent(rig):
    rig.gripper.calibrate()
    rig.live(0.1)
    begin = rig.clock.now()
    rig.adapter.inject(FaultKind.LOST, 2)
    while rig.state.phase is Phase.CALIBRATING:
        assert math.isnan(rig.state.opening)
        rig.gripper.turn()
    assert {message.data for message in rig.sent(begin)} == {b""}
    assert {message.id for message in rig.sent(begin) if not message.remote} == {0x07A}
    assert 0x038 in {message.id for message in rig.sent(begin) if message.remote}


@both_variants
@pytest.mark.parametrize("width", [0.003, 0.010, 0.020, 0.040])
def test_a_calibration_with_an_object_between_the_jaws_is_refused(rig, width):
    rig.emulated.jaws.object_opening = width
    rig.gripper.calibrate()
    state = rig.wait_for(Phase.UNCALIBRATED, Phase.READY)
    assert state.phase is Phase.UNCALIBRATED and math.isnan(state.opening)
    assert f"travelled {1e3 * (0.048 - width):.0f}" in state.message and "something between them" in state.message
    with pytest.raises(GripperStateError, match="something between them"):
        rig.gripper.move(0.03)
    rig.emulated.jaws.object_opening = None
    rig.gripper.calibrate()
    rig.wait_for(Phase.READY)
    rig.arrive(0.03)
    assert rig.emulated.jaws.opening == pytest.approx(0.03, abs=2e-4)


@both_variants
def test_a_recalibration_with_an_object_between_the_jaws_is_refused(rig):
    rig.gripper.calibrate()
    rig.wait_for(Phase.READY)
    rig.arrive(0.04)
    rig.emulated.jaws.object_opening = 0.012
    rig.gripper.calibrate()
    assert "something between them" in rig.wait_for(Phase.UNCALIBRATED, Phase.READY).message


@both_variants
@pytest.mark.parametrize("seed", range(6))
def test_lost_and_garbled_counts_do_not_hide_an_object_nor_invent_one(variant, seed):
    for width in (None, 0.012):
        rig = Rig(variant, calibrated=False)
        rig.emulated.jaws.object_opening = width
        rig.gripper.calibrate()
        kinds = (FaultKind.LOST, FaultKind.FLIPPED, FaultKind.LATE, FaultKind.GARBAGE)
        for number in range(12):
            rig.live(0.05 + 0.011 * seed)
            if rig.state.phase is Phase.CALIBRATING:
                rig.adapter.inject(kinds[(number + seed) % 4])
        state = rig.wait_for(Phase.UNCALIBRATED, Phase.READY)
        if width is not None:
            assert state.phase is Phase.UNCALIBRATED
        else:
            assert state.phase is Phase.READY or "replies were lost" in state.message


@both_variants
def test_a_stroke_that_the_settings_do_not_have_is_refused(variant):
    rig = Rig(variant, calibrated=False, stroke=0.040)
    rig.gripper.calibrate()
    assert "gripper.stroke" in rig.wait_for(Phase.UNCALIBRATED, Phase.READY).message


@both_variants
def test_a_gripper_that_does_not_tell_its_encoder_is_calibrated_and_that_is_said(rig):
    sent = rig.bus.send
    rig.bus.send = lambda message: None if message.id == 0x038 else sent(message)
    rig.gripper.calibrate()
    assert "is unknown" in rig.wait_for(Phase.UNCALIBRATED, Phase.READY).message
    assert rig.state.phase is Phase.READY


@both_variants
def test_a_second_calibration_ends_when_the_jaws_have_been_at_both_stops(rig):
    for _ in range(2):
        rig.gripper.calibrate()
        begin = rig.clock.now()
        rig.wait_for(Phase.READY)
        assert rig.clock.now() - begin > 0.7
        assert rig.emulated.mode.name == "IDLE"
        rig.arrive(0.03)


@both_variants
def test_a_calibration_that_got_lost_is_sent_again(rig):
    rig.adapter.inject(FaultKind.REQUEST_LOST)
    rig.gripper.calibrate()
    rig.wait_for(Phase.READY)
    assert len(rig.messages(Command.CALIBRATE)) == 2


@both_variants
def test_a_motor_that_never_starts_ends_the_calibration_with_advice(rig):
    rig.adapter.inject(FaultKind.REQUEST_LOST)
    lost = rig.bus.send
    rig.bus.send = lambda message: None if message.id == 0x07C else lost(message)
    rig.gripper.calibrate()
    assert "draws no current" in rig.wait_for(Phase.UNCALIBRATED).message


@both_variants
def test_a_fault_ends_a_calibration(rig):
    rig.gripper.calibrate()
    rig.live(0.5)
    rig.adapter.inject(FaultKind.OVERHEATED)
    assert rig.wait_for(Phase.FAULT).faults == ("temperature",)
    rig.live(1.0)
    rig.gripper.clear_errors()
    assert "restarts the gripper" in rig.wait_for(Phase.UNCALIBRATED).message


@both_variants
def test_a_stop_that_is_never_felt_ends_a_calibration(rig):
    rig.emulated.jaws.slips = True
    rig.gripper.calibrate()
    begin = rig.clock.now()
    state = rig.wait_for(Phase.UNCALIBRATED)
    assert "no end stop" in state.message or "gave the calibration up" in state.message
    assert rig.clock.now() - begin < 37.0


@both_variants
def test_hold_ends_a_calibration_limp_and_the_next_one_restarts_the_gripper(rig):
    rig.gripper.calibrate()
    rig.live(0.3)
    rig.gripper.hold()
    rig.live(0.1)
    assert rig.emulated.mode.name != "CALIBRATE" and not rig.emulated.order.action
    assert rig.state.phase is Phase.UNCALIBRATED
    begin = rig.clock.now()
    rig.gripper.calibrate()
    rig.wait_for(Phase.READY)
    assert len(rig.messages(Command.RESET, begin)) == 1
    assert rig.clock.now() - begin > 3.0
    assert rig.arrive(0.02).outcome is MoveOutcome.REACHED


@both_variants
def test_a_cut_short_recalibration_is_not_trusted_although_the_gripper_says_calibrated(rig):
    rig.gripper.calibrate()
    rig.wait_for(Phase.READY)
    rig.gripper.calibrate()
    rig.live(0.3)
    rig.gripper.estop()
    rig.wait_for(Phase.FAULT)
    rig.gripper.clear_errors()
    state = rig.wait_for(Phase.UNCALIBRATED)
    assert rig.emulated.calibrated
    assert not state.calibrated and math.isnan(state.opening)


@both_variants
@pytest.mark.parametrize("stiffness", [100.0, 800.0])  # N/m; the older calibration presses with 21 N
def test_something_soft_between_the_jaws_is_no_reason_to_doubt_the_gripper(rig, stiffness):
    rig.emulated.jaws.load = lambda opening: stiffness * max(0.0, 0.025 - opening)
    rig.gripper.calibrate()
    assert rig.wait_for(Phase.READY, Phase.UNCALIBRATED).phase is Phase.READY
    rig.live(0.5)  # limp, the jaws are pushed open; the stops were found all the same
    assert rig.emulated.jaws.opening == pytest.approx(0.025, abs=2e-3)
    assert rig.arrive(0.040).opening == pytest.approx(rig.emulated.jaws.opening, abs=2e-4)


@both_variants
def test_a_controller_that_is_no_gripper_is_found_out(rig):
    rig.emulated.configured = False
    rig.gripper.calibrate()
    assert "configure the controller as a gripper" in rig.wait_for(Phase.UNCALIBRATED).message


@both_variants
@pytest.mark.parametrize("command", ["calibrate", "clear_errors", "release_power"])
def test_commands_that_would_cut_a_calibration_short_are_refused(rig, command):
    rig.gripper.calibrate()
    rig.live(0.1)
    with pytest.raises(GripperStateError, match="cut short: wait"):
        getattr(rig.gripper, command)()
    with pytest.raises(GripperStateError, match="cut short: wait"):
        rig.gripper.move(0.02)
    assert rig.wait_for(*LIMP, Phase.READY).phase is Phase.READY


@both_variants
def test_moves_are_refused_before_a_calibration(rig):
    with pytest.raises(GripperStateError, match="not calibrated: calibrate it first"):
        rig.gripper.move(0.02)
    assert rig.orders() == []
