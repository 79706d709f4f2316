"""Claims about a replay through the real nodes, and about the stop of its processes."""

import json
import signal
import subprocess
import sys
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from time import monotonic, sleep
from types import SimpleNamespace

import numpy as np
import pytest
from eval_fakes import cut, with_both_jaws
from process_fakes import running

from finforce.ros.transport import free_domain
from finforce.transforms import pose_from_quaternion, quaternion_from_pose
from finforce_eval.cli.main import main
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.writer import write_recording
from finforce_eval.replay import replay as replaying
from finforce_eval.replay.answers import ReplayLog, live_result
from finforce_eval.replay.node import open_player

SHIPPED = Path(replaying.__file__).parents[1] / "data" / "bench_cyl25_middle"
MESH = SHIPPED.parent / "objects" / "cylinder_25.stl"
SECOND = 1_000_000_000


def solvers_of(domain):
    """The processes with solvers on a DDS domain."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            words = (folder / "cmdline").read_bytes()
            variables = (folder / "environ").read_bytes()
        except OSError:
            continue
        is_ours = any(b"finforce.ros.start\0" + name in words for name in (b"ifea_solver", b"finforce_pipeline"))
        if is_ours and f"ROS_DOMAIN_ID={domain}\0".encode() in variables:
            found.append(int(folder.name))
    return found


@pytest.mark.parametrize("ended", [True, False])
def test_a_context_that_a_signal_has_taken_away_is_no_fault(ended, monkeypatch):
    """The middleware's own error comes where the signal falls between the look at the context and the wait."""
    with open_player(free_domain()) as player:

        def fail(**_):
            if ended:
                player.context.shutdown()
            raise RuntimeError("failed to initialize wait set")

        monkeypatch.setattr(player._spinner, "spin_once", fail)
        with pytest.raises(KeyboardInterrupt if ended else RuntimeError):
            player.spin_until(monotonic() + 1.0)


def test_a_process_that_has_played_ends_at_a_signal_again():
    """In a process of its own: the handlers are those of all contexts."""
    program = (
        "from rclpy.signals import get_current_signal_handlers_options as handlers;"
        "from finforce_eval.replay.node import open_player\n"
        f"with open_player({free_domain()}): print(handlers().name)\n"
        "print(handlers().name)"
    )
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120)
    assert said.stdout.split() == ["ALL", "NO"]  # the middleware's handlers would let it go on


def test_a_signal_ends_the_replay_and_its_nodes():
    domain = free_domain()
    words = [sys.executable, "-m", "finforce_eval.cli.main", "replay", str(SHIPPED), "--domain", str(domain)]
    with running(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as replay:
        until = monotonic() + 120.0
        while not solvers_of(domain) and monotonic() < until:
            sleep(0.05)
        assert solvers_of(domain)
        sleep(1.0)
        replay.send_signal(signal.SIGTERM)
        output, _ = replay.communicate(timeout=30)
    assert replay.returncode == 130, output
    assert "Traceback" not in output
    assert not solvers_of(domain)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["no_such_bag"], "no such recording"),
        ([SHIPPED, "--rate", "0"], "--rate 0"),
        ([SHIPPED, "--domain", "500"], "--domain 500"),
        ([SHIPPED, "--jaw", "no_such_jaw"], "no_such_jaw"),
        ([SHIPPED, "--jaw", "steel"], "key points"),
    ],
)
def test_what_cannot_be_played_ends_with_two_and_one_line(words, reason, capsys):
    assert main(["replay", *map(str, words)]) == 2
    said = capsys.readouterr().err
    assert reason in said and len(said.strip().splitlines()) == 1


def test_estimated_contacts_without_a_mesh_are_refused(tmp_path, capsys):
    recording = read_recording(SHIPPED)
    start = recording.jaws["left"].keypoints.stamps_ns[0]
    short = write_recording(cut(recording, start, start + SECOND), tmp_path / "short")
    assert main(["replay", str(short), "--contact", "estimate"]) == 2 and "no object mesh" in capsys.readouterr().err


class FakeEstimator:
    """A jaw of four vertices."""

    surface_triangles = np.array([[0, 1, 2], [0, 2, 3]])

    class jaw:  # noqa: N801
        keypoints = np.zeros((15, 3))

    def surface(self):
        return np.zeros((4, 3))


def test_the_time_series_has_a_gap_where_no_wrench_came():
    recording = read_recording(SHIPPED)
    stamps = recording.jaws["left"].keypoints.stamps_ns
    log = ReplayLog(("left",))
    for stamp in stamps[::2].tolist():
        found = {"force": np.array([-2.0, 0, 0]), "torque": np.array([0.0, -0.08, 0])}
        log.rows["left"][stamp] = found | {"force_stddev": np.array([0.1, 0.5, 0.5]), "step_ms": 2.0}
    result = live_result(recording, "left", log, likelihood_threshold=0.6, estimator=FakeEstimator())
    assert result.solved[::2].all() and not result.solved[1::2].any()
    np.testing.assert_allclose(result.column("magnitude_stddev")[::2], 0.1)
    np.testing.assert_allclose(result.column("step_ms")[::2], 2.0)
    assert np.isnan(result.column("step_ms")[1::2]).all()
    assert result.scored.any() and not result.scored.all()


def test_images_with_key_points_before_the_first_wrench_wait_for_the_tare():
    recording = read_recording(SHIPPED)
    track = recording.jaws["left"]
    hidden = replace(track.keypoints, points=track.keypoints.points.copy())
    hidden.points[3] = np.nan
    recording = replace(recording, jaws={"left": replace(track, keypoints=hidden)})
    log, stamps = ReplayLog(("left",)), hidden.stamps_ns.tolist()
    for stamp in stamps[45::2]:
        log.rows["left"][stamp] = {"force": np.array([-2.0, 0, 0]), "force_stddev": np.full(3, 0.1)}
    status = live_result(recording, "left", log, likelihood_threshold=0.6, estimator=FakeEstimator()).column("status")
    assert status[:5].tolist() == ["waiting"] * 3 + ["no wrench", "waiting"]
    assert status[44:48].tolist() == ["waiting", "ok", "no wrench", "ok"]
    log.rows["left"].clear()  # nothing ever came: that is no wait
    silent = live_result(recording, "left", log, likelihood_threshold=0.6, estimator=FakeEstimator())
    assert set(silent.column("status")) == {"no wrench"}


def with_opposite_jaw(recording):
    """Give the right jaw the pose from which it sees the object as the left one does, turned by 180 degrees about z."""
    left, right, poses = recording.jaws["left"], recording.jaws["right"], recording.object_pose
    position, quaternion = [], []
    for T_object, T_left in zip(matrices(poses), matrices(left.pose), strict=True):
        T_left_right = np.diag([-1.0, -1.0, 1.0, 1.0])
        T_left_right[0, 3] = 2.0 * (np.linalg.inv(T_left) @ T_object)[0, 3]
        T = T_left @ T_left_right
        position.append(T[:3, 3])
        quaternion.append(quaternion_from_pose(T))
    pose = replace(left.pose, position=np.array(position), quaternion=np.array(quaternion))
    return replace(recording, jaws={"left": left, "right": replace(right, pose=pose)})


def matrices(track):
    return [pose_from_quaternion(*pair) for pair in zip(track.position, track.quaternion, strict=True)]


@pytest.fixture(scope="module")
def replayed(tmp_path_factory):
    """What a replay of a few seconds under load, seen on both jaws, found, printed and wrote."""
    folder = tmp_path_factory.mktemp("replay")
    recording = with_opposite_jaw(with_both_jaws(read_recording(SHIPPED), 5.0))
    both, out, found = write_recording(recording, folder / "both"), folder / "scores.json", []
    # at half speed a machine with other work keeps up as well
    words = [both, "--contact", "estimate", "--object", MESH, "--calibration", "bench", "--rate", "0.5", "--json", out]
    said = StringIO()

    def replay(*given, **options):
        found.append(replaying.replay(*given, **options))
        return found[0]

    with pytest.MonkeyPatch.context() as patch, redirect_stdout(said):
        patch.setattr("finforce_eval.cli.replay.replay", replay)
        assert main(["replay", *map(str, words)]) == 0
    return found[0], said.getvalue(), json.loads(out.read_text())


def test_every_image_comes_back_as_a_wrench_with_its_stamp_its_contact_estimated_on_the_way(replayed):
    result, said, scores = replayed
    for side in ("left", "right"):
        case = scores["cases"][f"both/{side}"]
        # the first images are silent until the offsets of the key points are known
        assert case["frames"] == len(result.recording.jaws[side].keypoints.stamps_ns) > 100 and case["solved"] > 60
        assert case["step_ms"]["p50"] > 0.0
    assert said.startswith("Grasp force: ") and len(result.grasp) > 60
    (state,) = [state for name, state in result.health.items() if "left contact" in name]
    assert "apart" in state["message"] or "touching" in state["message"]


def test_one_contact_estimator_serves_both_jaws_which_answer_alike_and_complete_the_grasp(replayed):
    """The right jaw is the left one's mirror image."""
    result, _, _ = replayed
    left, right = (result.evaluation.results[f"both/{side}"] for side in ("left", "right"))
    held = left.solved & right.solved
    assert held.sum() > 0.5 * len(held)
    # the same object, the same noise; each solver gets its contact a little earlier or later than the other
    np.testing.assert_allclose(right.magnitude[held], left.magnitude[held], atol=0.1)
    weaker = np.minimum(left.magnitude, right.magnitude)
    for stamp, magnitude in zip(left.stamps_ns[held], weaker[held], strict=True):
        assert result.grasp[int(stamp)] == pytest.approx(magnitude, abs=1e-6)
    assert result.health["finforce: right contact"]["status"] == result.health["finforce: left contact"]["status"]


def test_silence_after_the_end_of_a_recording_is_no_state_of_a_node():
    def report(name, text):
        return SimpleNamespace(status=[SimpleNamespace(name=name, message=text, values=[])])

    log = ReplayLog(("left",))
    log.take_diagnostics(report("jaw", "loaded"))
    log.take_diagnostics(report("jaw", "touching"))
    log.end()
    log.take_diagnostics(report("jaw", "nothing has arrived"))
    log.take_diagnostics(report("late", "never heard before"))
    assert {name: state["message"] for name, state in log.health.items()} == {
        "jaw": "touching",
        "late": "never heard before",
    }
