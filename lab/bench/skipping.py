"""CPU time of each node in three scenes, with the skip rules and without.

One rendered grasp has three scenes: idle (the object 15 mm from each jaw), approach (5 mm/s) and steady grasp. It is
played as images to all nodes, each in a process of its own, once with every rule and once with none.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd

from finforce.skipping import ALL
from finforce.stamps import NANOSECONDS
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.tracks import PhaseTrack
from finforce_eval.replay.node_run import describe_load, run_nodes
from finforce_eval.replay.playback import RawMessage
from finforce_eval.replay.processes import begin_shares, end_shares
from lab.bench.chain import SIDES, chain_processes
from lab.bench.streams import stream_images
from lab.harness import Figures
from lab.scenes import TwinScene, find_scene

SCENE = TwinScene(
    scenario="hold",
    seed=101,
    changes={"tare": 12.0, "clearance": 0.015, "closing_speed": 0.005, "record": 8.0, "settle": 0.5},
)
QUICK = {"tare": 7.0, "record": 5.5}  # [s]: three of idling and of holding are measured
RATE = 30  # [Hz]
WARM_UP, SETTLED = 4.0, 3.0  # [s] of idling, and of holding, before they are measured
SETTINGS = {"on": (), "off": (ALL,)}  # of the rules
MAX_AGE = 2.0  # [s]; a loaded machine shall be slow, not silent


def measure(quick: bool) -> Figures:
    """Return what each node takes in each scene, with the rules and without.

    Raises:
        MissingDependencyError: ROS 2 is not installed.
        FinforceError: the scene cannot be rendered, or a node ended early.
    """
    path = find_scene(replace(SCENE, changes={**SCENE.changes, **QUICK}) if quick else SCENE)
    recording, stream = read_recording(path), stream_images(path, RATE)
    spans, rows, loads = find_spans(recording.phases), [], []
    for setting, off in SETTINGS.items():
        more = {"max_age": MAX_AGE, "skip_off": list(off)}
        nodes = chain_processes(recording, images=True, composed=False)
        meter = SceneMeter(spans=spans)
        own = [replace(node, parameters={**node.parameters, **more}) for node in nodes]
        run = run_nodes(own, stream, SIDES, heard=(), watch=meter.note)
        loads.append(run.others)
        answered = np.array(list(run.log.grasp))
        for scene, shares in meter.shares.items():
            begin, end = spans[scene]
            answers = ((begin <= answered) & (answered < end)).sum() / (1e-9 * (end - begin))
            for node, share in shares.items():
                row = {"CPU/% of a core": share, "grasp forces/Hz": answers, "memory/MB": 1e-6 * run.memory[node]}
                rows.append({"node": node, "scene": scene, "rules": setting, **row})
    return Figures(tables={"skipping": arrange(pd.DataFrame(rows))}, notes=[describe_load(loads)])


def find_spans(phases: PhaseTrack) -> dict[str, tuple[int, int]]:
    """Return when each scene begins and ends [ns]: the loading ramp from 0 to 0 mm is the way to the object."""
    ramps = np.flatnonzero((phases.stage == "ramp") & (phases.direction == "load"))
    approach, press, release = (int(stamp) for stamp in phases.stamps[[ramps[0], ramps[1], ramps[1] + 3]])
    held = int(phases.stamps[ramps[1] + 1])
    return {
        "idle": (int(phases.stamps[0] + WARM_UP * NANOSECONDS), approach),
        "approach": (approach, press),
        "grasp": (int(held + SETTLED * NANOSECONDS), release),
    }


@dataclass(kw_only=True)
class SceneMeter:
    """Reads the CPU time of processes where a scene begins and ends.

    Attributes:
        spans: begin and end of each scene [ns].
        shares: CPU use of each process by scene [% of a core].
    """

    spans: Mapping[str, tuple[int, int]]
    shares: dict[str, Mapping[str, float]] = field(default_factory=dict)
    _scene: str = ""
    _processes: Mapping[str, Any] = field(default_factory=dict)

    def note(self, pids: Mapping[str, int], message: RawMessage) -> None:
        """Note that a message leaves."""
        scene = next((name for name, (begin, end) in self.spans.items() if begin <= message.time < end), "")
        if scene == self._scene:
            return
        if self._scene:
            self.shares[self._scene] = end_shares(self._processes)
        self._scene, self._processes = scene, begin_shares(pids)


def arrange(rows: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each node and scene, with the rules beside without: CPU use, answers a second and memory."""
    values = ["CPU/% of a core", "grasp forces/Hz", "memory/MB"]
    wide = rows.pivot_table(index=["node", "scene"], columns="rules", values=values, sort=False)
    wide.columns = [f"{rules}: {name}" for name, rules in wide.columns]
    return wide.reset_index()
