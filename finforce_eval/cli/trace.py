"""`finforce trace`: the way of a recording's images through the stages, in a table, from what every process noted."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd

from finforce_eval.cli.parser import PLAYED_HELP, CommandResult, add_run_options
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.keypoint_source import parse_source
from finforce_eval.evaluation.setup import make_setup, read_recordings
from finforce_eval.replay.node_run import Playing
from finforce_eval.replay.replay import play_to_nodes


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add what names the recording, and how the stages run."""
    parser.add_argument("bag", metavar="BAG", help=f"{PLAYED_HELP}, with key points, or images and camera_info")
    add_run_options(parser, settings=False)


def run(options: argparse.Namespace) -> CommandResult:
    """Play a recording in real time and print where the time went.

    Raises:
        FinforceError: an option, the recording or a node fails.
    """
    keypoints = parse_source(options)
    (recording,) = read_recordings([options.bag], keypoints)
    with TemporaryDirectory() as folder:
        playing = Playing(trace=folder)
        log = play_to_nodes(
            recording,
            make_setup(options),
            calibration_file=options.calibration or "",
            playing=playing,
            source=keypoints,
        ).log
        sent = {stamp: time for times in log.sent.values() for stamp, time in times.items()}
        figures = stage_figures(read_spans(Path(folder), log.offset, sent), list(log.grasp_latency.values()))
    lost = {name: state["refused"] for name, state in log.health.items() if "refused" in state}
    print(format_trace(figures, len(sent), lost))
    return CommandResult({"stages": figures, "images": len(sent), "lost": lost})


WAY = "image out to grasp force in"
PERCENTS = (50, 95, 99)
OTHER_WORK = ("/diagnostics", "/clock", "/camera/camera/color/camera_info")


def read_spans(folder: Path, offset: int, sent: Mapping[int, float]) -> pd.DataFrame:
    """Return what processes have noted of images, a row for each callback in the order of their beginnings.

    Args:
        folder: of their files.
        offset: by which stamps were later than they were recorded [ns].
        sent: when each image left, by its recorded stamp [s, monotonic].

    Returns:
        `image`, its recorded stamp [ns]; `stage`, node and topic in a few words; `begin` and `end` after the image had
        left [ms]; `own` time in which the callback did not wait for another stage that it had called [ms].

    Raises:
        RecordingError: there is nothing.
    """
    rows = []
    for path in sorted(folder.glob("*.json")):
        noted = json.loads(path.read_text(encoding="utf-8"))
        owned = _own_times([(begin, end) for *_, begin, end in noted])
        for (node, topic, stamp, begin, end), own in zip(noted, owned, strict=True):
            left = sent.get(stamp - offset)
            if left is not None and topic not in OTHER_WORK:
                stage = f"{node}: {topic.lstrip('/').removeprefix('camera/camera/')}"
                rows.append((stamp - offset, stage, 1e-6 * begin - 1e3 * left, 1e-6 * end - 1e3 * left, 1e-6 * own))
    if not rows:
        raise RecordingError("no stage has noted anything of an image; expected at least one image to be answered")
    return pd.DataFrame(rows, columns=["image", "stage", "begin", "end", "own"]).sort_values(["image", "begin"])


def _own_times(spans: Sequence[tuple[int, int]]) -> list[int]:
    """Return how long each of nested spans (begin, end) was at work itself."""
    own = [end - begin for begin, end in spans]
    order = sorted(range(len(spans)), key=lambda i: (spans[i][0], -spans[i][1]))
    around: list[int] = []
    for index in order:
        begin, end = spans[index]
        while around and spans[around[-1]][1] <= begin:
            around.pop()
        if around:
            own[around[-1]] -= end - begin
        around.append(index)
    return own


def stage_figures(spans: pd.DataFrame, latencies: Sequence[float]) -> dict[str, dict[str, Any]]:
    """Return by stage how often it was at work, for how long itself, and when it began [ms], and the whole way.

    Args:
        spans: see `read_spans`.
        latencies: of answered images, from leaving to the grasp force's arrival [s].
    """
    found = {
        stage: {"n": len(rows), "own_ms": _percentiles(rows["own"]), "begin_ms": _percentiles(rows["begin"])}
        for stage, rows in spans.groupby("stage", sort=False)
    }
    ordered = dict(sorted(found.items(), key=lambda entry: entry[1]["begin_ms"][0]))
    late = _percentiles(1e3 * np.asarray(latencies))
    return {**ordered, WAY: {"n": len(latencies), "own_ms": late, "begin_ms": [0.0] * len(PERCENTS)}}


def _percentiles(values: Sequence[float]) -> list[float]:
    return np.percentile(values, PERCENTS).tolist() if len(values) else [float("nan")] * len(PERCENTS)


def format_trace(stages: Mapping[str, Mapping[str, Any]], images: int, lost: Mapping[str, str]) -> str:
    """Return a table of the stages in Markdown, and by which node how many of all images were lost."""
    lines = ["| stage | images | begins at p50/ms | takes p50/ms | p95 | p99 |", "|---|---:|---:|---:|---:|---:|"]
    for name, figures in stages.items():
        times = " | ".join(f"{value:.2f}" for value in (figures["begin_ms"][0], *figures["own_ms"]))
        lines.append(f"| {name} | {figures['n']} | {times} |")
    lines += ["", f"{stages[WAY]['n']} of {images} images answered. Where the others went, by the nodes themselves:"]
    return "\n".join([*lines, *(f"- {name}: {why}" for name, why in lost.items())])
