"""A recording through the real nodes, in real time, scored against the measured force."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from finforce.camera_topics import COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC
from finforce.gripper_frames import SIDES
from finforce.health import IDLE, STILL
from finforce.systems.processes import Process, ReplayOptions, compose, replay_processes
from finforce_eval.errors import RecordingError, SilentReplayError
from finforce_eval.evaluation.contact_source import FIXED, ContactChoice
from finforce_eval.evaluation.forces import check_keypoint_count, truth_sides
from finforce_eval.evaluation.gripper import with_gripper
from finforce_eval.evaluation.keypoint_source import (
    IMAGES,
    TRUTH,
    KeypointSource,
    awaiting_keypoints,
    build_records,
    choose_images,
)
from finforce_eval.evaluation.scoring import Evaluation, GraspScore, score_grasp, score_results
from finforce_eval.evaluation.setup import EvaluationSetup
from finforce_eval.recordings.images import ImageTrack
from finforce_eval.recordings.objects import find_mesh, read_friction, require_mesh
from finforce_eval.recordings.tracks import Recording
from finforce_eval.recordings.writer import write_recording
from finforce_eval.replay.answers import ReplayLog, live_result, with_heard_keypoints
from finforce_eval.replay.node_run import Playing, run_nodes
from finforce_eval.replay.playback import Playback
from finforce_ifea.jaw.jaw import Jaw

RESULTS = ("wrench", "wrench_stddev", "surface", "markers", "contact", "object_outline")


@dataclass(frozen=True, kw_only=True)
class Replay:
    """The outcome of a replay.

    Attributes:
        evaluation: scores and time series; their step times are from key points out to wrench in.
        grasp: stamp [ns] -> grasp force [N].
        health: node -> its last diagnostics.
        grasp_score: error and delay of the grasp force.
        recording: that was played, with the key points that it was played with.
    """

    evaluation: Evaluation
    grasp: Mapping[int, float]
    health: Mapping[str, Mapping[str, str]]
    grasp_score: GraspScore
    recording: Recording


def replay(
    recording: Recording,
    setup: EvaluationSetup,
    *,
    calibration_file: str = "",
    playing: Playing | None = None,
    keypoints: KeypointSource | None = None,
) -> Replay:
    """Play a recording through solver nodes, one process per jaw, and score what they answer.

    From images it goes through the key point detector's node, too. Nothing outlives the call.

    Args:
        recording: the recording to play.
        setup: jaw, settings and contact.
        calibration_file: as the nodes load it; empty for none.
        playing: rate, domain and trace.
        keypoints: where the key points come from; where they were recorded, else from images, without it.

    Raises:
        RecordingError: no ground truth, another number of key points than the jaw's, or no wrench came.
        ProcessError: a node cannot be started, or ended early.
        MissingDependencyError: ROS 2 is not installed.
    """
    truth_sides(recording)
    played = play_to_nodes(
        recording, setup, calibration_file=calibration_file, playing=playing or Playing(), source=keypoints
    )
    recording, log = played.recording, played.log
    if played.from_images:
        recording = with_heard_keypoints(recording, log)
    evaluation = _score(recording, setup, log)
    return Replay(
        evaluation=evaluation,
        grasp=log.grasp,
        health=log.health,
        grasp_score=score_grasp(recording, log.grasp, log.grasp_latency),
        recording=recording,
    )


class Played(NamedTuple):
    """A recording with the key points that it was played with, what was answered, and whether it was seen in images."""

    recording: Recording
    log: ReplayLog
    from_images: bool


def play_to_nodes(
    recording: Recording,
    setup: EvaluationSetup,
    *,
    calibration_file: str,
    playing: Playing,
    source: KeypointSource | None = None,
) -> Played:
    """Play a recording through the nodes and return what they answered; see `replay`."""
    keypoints = source or KeypointSource(jaw_file=str(setup.jaw.path))
    sides, from_images = tuple(recording.jaws), keypoints.source_of(recording) == IMAGES
    with ExitStack() as stack:
        recording = _choose_keypoints(recording, setup.jaw, keypoints, stack)
        images = recording.images if from_images else None
        # a recording of a live run holds what the nodes write, too
        written = {f"/{side}/{name}" for side in sides for name in RESULTS}
        written |= {"/grasp_wrench", "/manipulation_wrench", "/diagnostics", "/clock", "/rosout"}
        messages = Playback(recording.source, written | _unplayed(sides, from_images), images)
        options = _graph_options(recording, setup, calibration_file, playing)
        processes = replay_processes(replace(options, images=from_images, composed=False), Path())
        processes = _for_scores(processes, recording, setup, keypoints)
        heard = () if playing.trace else sides
        run = run_nodes(compose(processes), messages, sides, heard=heard, detector=from_images, playing=playing)
    return Played(recording, run.log, from_images)


def _choose_keypoints(recording: Recording, jaw: Jaw, keypoints: KeypointSource, stack: ExitStack) -> Recording:
    """Return a recording with the key points that are played, without any where images will give them.

    Raises:
        RecordingError: they are of another number than the jaw's, or come from images that are in no bag.
    """
    source = keypoints.source_of(recording)
    if source == IMAGES:
        if not isinstance(recording.images, ImageTrack):
            raise RecordingError(
                f"{recording.name}: only bags are played through the nodes; annotate and evaluate take other "
                "recordings, too"
            )
        depth = build_records(keypoints.node_parameters(recording)).parameters.depth
        recording = replace(awaiting_keypoints(recording), images=choose_images(recording, depth))
    elif source == TRUTH:
        recording = _write_truth(keypoints.apply(recording), stack)
    for side in recording.jaws if source != IMAGES else ():
        check_keypoint_count(recording, side, jaw)
    return recording


def _write_truth(recording: Recording, stack: ExitStack) -> Recording:
    """Return a recording that has been written to a folder of its own, for as long as the stack lasts."""
    folder = Path(stack.enter_context(TemporaryDirectory())) / recording.name.replace("/", "_")
    plain = replace(recording, images=None)
    mesh = find_mesh(recording)
    if mesh is not None:
        plain = replace(plain, case={**recording.case, "mesh": str(mesh.resolve())})
    return replace(plain, path=write_recording(plain, folder))


def _unplayed(sides: Sequence[str], from_images: bool) -> set[str]:
    """Return the topics that are found anew, or those of the camera where nobody looks at its images."""
    if from_images:
        return {f"/{side}/{name}" for side in sides for name in ("keypoints", "jaw_pose")}
    return {COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC}


def _for_scores(
    processes: Sequence[Process], recording: Recording, setup: EvaluationSetup, keypoints: KeypointSource
) -> list[Process]:
    """Return the processes: they answer every image, so that each is scored, as the options of the command say."""
    more = {name: {"skip_off": [IDLE, STILL]} for name in ("keypoint_detector", "contact_estimator", "ifea_solver")}
    more["ifea_solver"] |= {"estimator.mesh": setup.settings.mesh}
    if (friction := read_friction(recording)) is not None:
        more["ifea_solver"] |= {"estimator.friction": friction.mean, "estimator.friction_stddev": friction.stddev}
    if (mode := _contact_mode(recording, setup.contacts)) != FIXED:
        density = {} if setup.settings.solver == "paper" else {"contact.mesh": setup.settings.mesh}
        more["contact_estimator"] |= {
            "contact.mode": mode,
            "compare_mesh": setup.contacts.compare_mesh,
            **density,
        }
    if any(each.executable == "keypoint_detector" for each in processes):
        more["keypoint_detector"] |= keypoints.node_parameters(recording)
    return [replace(each, parameters={**each.parameters, **more.get(each.executable, {})}) for each in processes]


def _graph_options(
    recording: Recording, setup: EvaluationSetup, calibration_file: str, playing: Playing
) -> ReplayOptions:
    """Return what the graph of the solvers is asked for."""
    sides = list(recording.jaws)
    return ReplayOptions(
        jaws="both" if len(sides) == 2 else sides[0],
        jaw_file=str(setup.jaw.path),
        calibration_file=calibration_file,
        **_contact_options(recording, setup.contacts),
        solver=setup.settings.solver,
        use_sim_time=playing.has_clock,
    )


def _contact_mode(recording: Recording, choice: ContactChoice) -> str:
    """Return how the contacts of all jaws are found, or that their height is fixed."""
    modes = {choice.mode_for(recording, side) for side in recording.jaws}
    return modes.pop() if len(modes) == 1 else FIXED


def _contact_options(recording: Recording, choice: ContactChoice) -> dict[str, Any]:
    """Return a height for the solvers, or what the contact estimator of all jaws needs.

    Raises:
        FinforceError: height, mesh or poses are missing.
    """
    mode = _contact_mode(recording, choice)
    if mode == FIXED:
        return {"contact_height": choice.height(recording)}
    for side, track in recording.jaws.items():
        if recording.object_pose is None or not (track.pose or track.is_awaited):
            needed = f"/object_pose and /{side}/jaw_pose"
            raise RecordingError(f"{recording.name}: --contact {mode} needs {needed}; give --contact fixed:Z_MM")
    mesh = require_mesh(recording, choice.object_file).resolve()
    return {"object_mesh": str(mesh), "object_mesh_unit": choice.object_unit}


def _score(recording: Recording, setup: EvaluationSetup, log: ReplayLog) -> Evaluation:
    """Score the wrenches of every jaw with ground truth.

    Raises:
        SilentReplayError: there are none.
    """
    results = []
    sides = truth_sides(recording)
    for side in sides:
        if not any("force" in row for row in log.rows[side].values()):
            raise SilentReplayError(f"{recording.name}: no wrench came on {side}/wrench: {_words(log, side)}")
        estimator = setup.side(side).estimator()
        threshold = setup.settings.likelihood_threshold
        result = live_result(recording, side, log, likelihood_threshold=threshold, estimator=estimator)
        results.append(result if len(sides) == 1 else result.renamed(f"{recording.name}/{side}"))
    if len(sides) == len(SIDES):
        results = list(with_gripper(dict(zip(sides, results, strict=True)), recording).values())
    return score_results(results, [recording])


def _words(log: ReplayLog, side: str) -> str:
    """Return the last diagnostics of a jaw, those of the key point detector first, where it runs."""
    messages = [log.health[name]["message"] for name in _sources(side) if name in log.health]
    return "; ".join(messages) or "no diagnostics either"


def _sources(side: str) -> tuple[str, str]:
    """Return under which names the nodes report on a jaw."""
    return f"finforce: {side} key points", f"finforce: {side} jaw"
