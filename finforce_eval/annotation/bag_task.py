"""Recordings into recordings with forces: a task each."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from finforce_eval.annotation.bag import ForceMessages, new_folder, write_annotated
from finforce_eval.annotation.forces import estimate_forces
from finforce_eval.engine.settings import sides_of
from finforce_eval.engine.tasks import OK, Task, hash_settings, make_line
from finforce_eval.evaluation.keypoint_source import parse_source
from finforce_eval.evaluation.manipulation import combine_jaws
from finforce_eval.evaluation.setup import EvaluationSetup
from finforce_eval.evaluation.warm import open_warm
from finforce_eval.machine import version
from finforce_eval.recordings.bags import bag_source, list_files
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.tracks import Recording
from finforce_eval.table import ForceSeries

NOTE = "annotation.json"


def bag_task(name: str, source: Path, target: Path, options: argparse.Namespace, settings: Mapping[str, Any]) -> Task:
    """Return the task of annotating a bag; nothing of it is read yet but its place.

    `settings` are what `describe_options` says of the options. Where there is no such recording, the task says so.
    """
    key = hash_settings(settings, list_files(source))
    given = {
        "source": str(source),
        "target": str(target),
        "options": vars(options) | {"run": None},
        "settings": hash_settings(settings),
        "key": key,
    }
    return Task(name=name, key=key, work=annotate_bag, given=given, output=str(target))


def annotate_bag(source: str, target: str, options: Mapping[str, Any], settings: str, key: str) -> dict[str, Any]:
    """Write a recording with forces and return figures of it.

    Args:
        source: rosbag2 folder, .mcap or .db3 file.
        target: the new folder.
        options: of the command `annotate`.
        settings: hash of them and of the files that they name.
        key: of the task, which is kept beside what was written.

    Raises:
        FinforceError: the recording cannot be read, or no forces be found in it.
        OSError: the folder cannot be written.
    """
    chosen = argparse.Namespace(**options)
    warm, keypoints = open_warm(settings, chosen), parse_source(chosen)
    recording = read_recording(source, keypoints.pairing, sides_of(chosen), strict=keypoints.strict)
    recording = keypoints.apply(replace(recording, name=Path(source).stem))
    jaws = estimate_forces(recording, warm.setup, build=warm.estimator)
    grasp = combine_jaws(jaws)
    figures = _figures(recording, jaws, list(recording.notes))
    note = {"key": key, "status": OK, "figures": figures, "settings": _settings(warm.setup), "version": version()}
    with new_folder(Path(target)) as folder:
        messages, bag = ForceMessages(jaws, grasp), bag_source(recording.source)
        write_annotated(recording, bag, messages, folder, side_file=chosen.side_file)
        (folder / NOTE).write_text(json.dumps(note, indent=1) + "\n", encoding="utf-8")
    return figures


def _settings(setup: EvaluationSetup) -> dict[str, str]:
    return {name: str(value) for name, value in setup.about.items()}


def _figures(recording: Recording, jaws: Mapping[str, ForceSeries], notes: list[str]) -> dict[str, Any]:
    """Return what is said of a recording in the manifest."""
    sides = {}
    for side, forces in jaws.items():
        solved = forces.solved
        words, counts = np.unique(forces.column("status")[~solved], return_counts=True)
        sides[side] = {
            "images": len(forces),
            "answered": int(solved.sum()),
            "unanswered": dict(zip(words.tolist(), counts.tolist(), strict=True)),
            "largest_N": float(np.nanmax(forces.magnitude)) if solved.any() else float("nan"),
        }
    stamps = np.concatenate([forces.stamps for forces in jaws.values()])
    span = 1e-9 * float(stamps.max() - stamps.min()) if len(stamps) else 0.0
    return {"jaws": sides, "span_s": round(span, 3), "notes": notes}


def ended_before(task: Task) -> dict[str, Any] | None:
    """Return the line of a task whose folder is whole already, None of another; a run may be killed in between."""
    path = Path(task.given["target"]) / NOTE
    try:
        note = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    if not isinstance(note, dict) or note.get("key") != task.key:
        return None
    return make_line(task, figures=note.get("figures"))
