"""`finforce replay`: a recording through the real nodes, in real time, scored against the measured force."""

from __future__ import annotations

import argparse
import math
import random
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic, time_ns
from typing import Any

from tqdm import tqdm

from finforce_eval.cli import Parser, add_jaw_options
from finforce_eval.commands import Setup, make_setup, truth_sides, write_json
from finforce_eval.contacts import FIXED, ContactChoice
from finforce_eval.errors import RecordingError
from finforce_eval.evaluate import Evaluation, check_keypoint_count, score_results
from finforce_eval.live import ReplayLog, live_result
from finforce_eval.objects import require_mesh
from finforce_eval.playback import RawMessage, read_playback
from finforce_eval.processes import ProcessError, ProcessGroup
from finforce_eval.recording import read_recording
from finforce_eval.results import CaseResult
from finforce_eval.tables import evaluation_json, format_table
from finforce_eval.tracks import Recording
from finforce_graph import Process, ReplayOptions, replay_processes
from finforce_ifea.errors import MissingDependencyError

PATIENCE = 180.0  # s; a first start compiles the element loops
LINGER = 0.3  # s; the last answers may still be on their way when the last message has left
RESULTS = ("wrench", "wrench_stddev", "surface", "markers", "contact", "object_outline")


@dataclass(frozen=True, kw_only=True)
class Playing:
    """How a recording is played.

    Attributes:
        rate: speed; other than 1 the recorded stamps stay and the nodes take their time from /clock.
        sim_time: the same at the recorded speed; else the stamps are shifted to now.
        domain: ROS_DOMAIN_ID; None takes one by chance.
        parameter_file: YAML file with further ROS parameters of the solvers.
    """

    rate: float = 1.0
    sim_time: bool = False
    domain: int | None = None
    parameter_file: str = ""

    @property
    def has_clock(self) -> bool:
        """Whether the nodes take their time from /clock."""
        return self.sim_time or self.rate != 1.0


@dataclass(frozen=True, kw_only=True)
class Replay:
    """What came of a replay.

    Attributes:
        evaluation: scores and time series; their step times are from key points out to wrench in.
        grasp: stamp [ns] -> grasp force [N].
        health: node -> its last diagnostics.
    """

    evaluation: Evaluation
    grasp: Mapping[int, float]
    health: Mapping[str, Mapping[str, str]]


def replay(recording: Recording, setup: Setup, *, calibration_file: str = "", playing: Playing | None = None) -> Replay:
    """Play a recording through solver nodes, one process per jaw, and score what they answer.

    Nothing outlives the call.

    Args:
        recording: what is played.
        setup: jaw, settings and contact.
        calibration_file: as the nodes load it; empty for none.
        playing: how it is played.

    Raises:
        RecordingError: no ground truth, another number of key points than the jaw's, or no wrench came.
        ProcessError: a node cannot be started, or ended early.
        MissingDependencyError: ROS 2 is not installed.
    """
    playing = playing or Playing()
    for side in truth_sides(recording):
        check_keypoint_count(recording, side, setup.jaw)
    sides = tuple(recording.jaws)
    messages = read_playback(recording.path, without=_results_of(sides))
    processes = replay_processes(_graph_options(recording, setup, calibration_file, playing), Path())
    log = ReplayLog(sides)
    _run(processes, messages, log, playing)
    return Replay(evaluation=_score(recording, setup, log), grasp=log.grasp, health=log.health)


def _results_of(sides: Sequence[str]) -> set[str]:
    """Return the topics that the nodes write; a recording of a live run holds them, too."""
    own = {f"/{side}/{name}" for side in sides for name in RESULTS}
    return own | {"/grasp_wrench", "/manipulation_wrench", "/diagnostics", "/clock", "/rosout"}


def _graph_options(recording: Recording, setup: Setup, calibration_file: str, playing: Playing) -> ReplayOptions:
    """Return what the graph of the solvers is asked for."""
    sides = list(recording.jaws)
    return ReplayOptions(
        jaws="both" if len(sides) == 2 else sides[0],
        jaw_file=str(setup.jaw.path),
        calibration_file=calibration_file,
        **_contact_options(recording, setup.contacts),
        solver=setup.settings.solver,
        mesh=setup.settings.mesh,
        parameter_file=playing.parameter_file,
        use_sim_time=playing.has_clock,
    )


def _contact_options(recording: Recording, choice: ContactChoice) -> dict[str, Any]:
    """Return a height for the solvers, or what the contact estimator of all jaws needs.

    Raises:
        FinforceError: height, mesh or poses are missing.
    """
    modes = {choice.mode_for(recording, side) for side in recording.jaws}
    mode = modes.pop() if len(modes) == 1 else FIXED
    if mode == FIXED:
        return {"contact_height": choice.height(recording)}
    for side, track in recording.jaws.items():
        if recording.object_pose is None or track.pose is None:
            needed = f"/object_pose and /{side}/jaw_pose"
            raise RecordingError(f"{recording.name}: --contact {mode} needs {needed}; give --contact fixed:Z_MM")
    mesh = require_mesh(recording, choice.object_file).resolve()
    return {"contact": mode, "object_mesh": str(mesh), "object_mesh_unit": choice.object_unit}


def _run(processes: Sequence[Process], messages: Sequence[RawMessage], log: ReplayLog, playing: Playing) -> None:
    """Start the nodes, wait until they listen, play, and end them."""
    try:
        from finforce_eval.node import open_player
    except ImportError as error:
        raise MissingDependencyError(f"replay needs ROS 2: pip install 'finforce[ros]' ({error})") from error
    domain = random.randint(1, 99) if playing.domain is None else playing.domain
    awaited = [f"/{side}/keypoints" for side in log.jaws]
    if any(process.executable == "contact_estimator" for process in processes):
        awaited += ["/object_pose", *(f"/{side}/jaw_pose" for side in log.jaws)]
    with ExitStack() as stack:
        player = stack.enter_context(open_player(domain))
        nodes = stack.enter_context(ProcessGroup(processes, {"ROS_DOMAIN_ID": str(domain)}))
        player.offer(messages)
        player.listen(log.jaws, log)

        def ready() -> bool:
            nodes.check()
            return player.has_listeners(awaited)

        if not player.wait_for(ready, PATIENCE):
            raise ProcessError(f"nobody listens to {' or '.join(awaited)} after {PATIENCE:g} s")
        player.spin_until(monotonic() + LINGER)
        bar = stack.enter_context(tqdm(total=len(messages), unit="msg", desc="replay", disable=None))
        log.offset = 0 if playing.has_clock else time_ns() - messages[0].time

        def sent(message: RawMessage) -> None:
            nodes.check()
            log.take_sent(message.topic, message.stamp, monotonic())
            bar.update()

        offset = None if playing.has_clock else log.offset
        player.play(messages, rate=playing.rate, offset=offset, sent=sent)
        log.ended = True
        player.spin_until(monotonic() + LINGER)
        nodes.check()


def _score(recording: Recording, setup: Setup, log: ReplayLog) -> Evaluation:
    """Score the wrenches of every jaw with ground truth.

    Raises:
        RecordingError: there are none.
    """
    results: list[CaseResult] = []
    sides = truth_sides(recording)
    for side in sides:
        if not log.jaws[side].force:
            raise RecordingError(f"{recording.name}: no wrench came on {side}/wrench: {_words(log, side)}")
        estimator = setup.side(side).estimator()
        threshold = setup.settings.likelihood_threshold
        result = live_result(recording, side, log.jaws[side], likelihood_threshold=threshold, estimator=estimator)
        results.append(result if len(sides) == 1 else replace(result, name=f"{recording.name}/{side}"))
    return score_results(results, [recording])


def _words(log: ReplayLog, side: str) -> str:
    """Return what the diagnostics of a jaw said last."""
    return log.health.get(f"finforce: {side} jaw", {}).get("message", "no diagnostics either")


def format_replay(result: Replay) -> str:
    """Return the table of the score, with the state of the nodes below."""
    lines = [format_table(result.evaluation), ""]
    lines.append("Step times are from key points out to wrench in, over the middleware and back.")
    lines.append(f"grasp_wrench: {len(result.grasp)} messages, largest {_largest(result.grasp):.2f} N.")
    for name, state in result.health.items():
        own = " / ".join(state.get(f"callback to published {part} [ms]", "-") for part in ("p50", "p95"))
        lines.append(f"{name}: {state['message']}; refused: {state.get('refused', '-')}; in the node {own} ms")
    return "\n".join(lines)


def _largest(values: Mapping[int, float]) -> float:
    return max(values.values(), default=math.nan)


def build_parser() -> Parser:
    """Return the parser of `finforce replay`."""
    text = "play a recording through the real nodes in real time and score it"
    parser = Parser(prog="finforce replay", description=text)
    parser.add_argument("bag", metavar="BAG", help="rosbag2 folder, .mcap or .db3 file")
    add_jaw_options(parser)
    parser.add_argument("--calibration", metavar="FILE", help="calibration file, or a shipped name")
    parser.add_argument("--rate", type=float, default=1.0, help="speed; other than 1 on /clock (1)")
    parser.add_argument("--sim-time", action="store_true", help="keep the stamps, give the time on /clock")
    parser.add_argument(
        "--domain", type=int, metavar="ID", help="ROS_DOMAIN_ID, to look on with RViz; else one by chance"
    )
    parser.add_argument("--params", default="", metavar="FILE", help="further ROS parameters of the solvers")
    parser.add_argument("--json", metavar="OUT", help="write the scores as JSON")
    parser.add_argument("--report", metavar="DIR", help="write pictures and a page that shows them")
    return parser


def main(argv: Sequence[str]) -> int:
    """Run `finforce replay`.

    Raises:
        FinforceError: an option, the recording or a node fails.
    """
    parser = build_parser()
    options = parser.parse_args(argv)
    if not 0.01 <= options.rate <= 100.0:
        parser.error(f"--rate {options.rate:g}: expected 0.01 to 100")
    if options.domain is not None and not 0 <= options.domain <= 232:
        parser.error(f"--domain {options.domain}: expected 0 to 232")
    setup = make_setup(options)
    playing = Playing(
        rate=options.rate, sim_time=options.sim_time, domain=options.domain, parameter_file=options.params
    )
    recording = read_recording(options.bag)
    result = replay(recording, setup, calibration_file=options.calibration or "", playing=playing)
    print(format_replay(result))
    _write(result, setup, options)
    return 0


def _write(result: Replay, setup: Setup, options: argparse.Namespace) -> None:
    """Write what was asked for."""
    if options.json:
        write_json(options.json, evaluation_json(result.evaluation, **setup.about))
    if options.report:
        from finforce_eval.report import write_report

        names = setup.jaw.keypoint_names
        page = write_report(result.evaluation, options.report, keypoint_names=names, about=setup.about)
        print(f"Report: {page}")
