"""The subcommand `report`: forces over time, evaluated or recorded, as one HTML page."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from finforce.gripper_frames import SIDES
from finforce.messages import NANOSECONDS, stamp_of
from finforce_eval.cli.parser import CommandResult
from finforce_eval.errors import OptionError, RecordingError
from finforce_eval.evaluation.batch import SCORED, read_evaluations
from finforce_eval.evaluation.scoring import match_truth
from finforce_eval.figures.report import PageHead, write_html, write_page
from finforce_eval.machine import version
from finforce_eval.recordings.bags import bag_source, check_types, open_bag
from finforce_eval.recordings.dataset import Dataset, is_dataset, open_dataset, read_parquet, rows_of
from finforce_eval.recordings.recording import WRENCH
from finforce_eval.recordings.tracks import WrenchTrack, stack_vectors
from finforce_eval.recordings.writer import STATUS
from finforce_eval.table import ForceSeries, read_table, stddev_along
from finforce_eval.tasks import is_manifest


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    text = "recordings, LeRobot datasets or tables (.parquet) with forces, or output folders of finforce "
    text += "evaluate --out"
    parser.add_argument("sources", nargs="+", metavar="SOURCE", help=text)
    parser.add_argument("-o", "--output", default="report.html", metavar="FILE", help="page to write (report.html)")
    parser.add_argument("--title", default="Forces", help="heading of the page (Forces)")


def run(options: argparse.Namespace) -> CommandResult:
    """Write the page and name it.

    Raises:
        FinforceError: a source holds no forces, or the name of the page is none.
    """
    page = Path(options.output)
    if page.suffix not in (".html", ".htm"):
        raise OptionError(f"--output {page}: expected a name that ends in .html")
    tables, recorded = [], []
    sources = [Path(source) for source in options.sources if not is_manifest(Path(source))]
    for source in sources:
        files = sorted(source.glob("*.parquet")) if source.is_dir() else [source] * (source.suffix == ".parquet")
        for file in files:
            series, about = read_table(file)
            if SCORED in about:
                tables.append(file)
                continue
            alike = len({each.name for each in series}) < len(series)
            recorded += [each.renamed(f"{each.name}/{each.side}") for each in series] if alike else series
        recorded += [] if files else read_forces(source)
    if not tables and not recorded:
        raise OptionError(f"{' '.join(options.sources)}: only a manifest; expected the recordings next to it")
    if tables and recorded:
        raise OptionError("recordings and folders of evaluations: expected the one or the other")
    if tables:
        evaluation, about = read_evaluations(tables)
        write_page(evaluation, page, PageHead(options.title, about))
    else:
        write_html(recorded, page, PageHead(options.title, {"version": version()}))
    count = len(recorded) or len(evaluation.results)
    print(f"Page: {page}: {count} plots")
    return CommandResult({"page": str(page), "plots": count})


_FORCE, _STDDEV, _STATUS, _TRUTH = KINDS = ("wrench", "wrench_stddev", "wrench_status", "ground_truth_wrench")


def read_forces(path: Path) -> list[ForceSeries]:
    """Return the forces on the jaws of a recording, or of the episodes of a dataset.

    Args:
        path: rosbag2 folder, .mcap or .db3 file, or folder of a LeRobot dataset.

    Raises:
        RecordingError: it cannot be read, or holds no forces.
    """
    if is_dataset(path):
        return _read_episodes(open_dataset(path, None))
    source = bag_source(path)
    types = {f"/{side}/{kind}": (STATUS if kind == _STATUS else WRENCH,) for side in SIDES for kind in KINDS}
    samples: dict[str, list[Any]] = {}
    with open_bag(source, path.stem) as bag:
        check_types(bag.connections, types, path.stem)
        for sample in bag.raw(types):
            samples.setdefault(sample.topic, []).append(bag.decode(sample))
    sides = [side for side in SIDES if f"/{side}/{_FORCE}" in samples]
    if not sides:
        raise RecordingError(f"{path.stem}: no forces: /left/wrench and /right/wrench have no messages; see annotate")
    return [_make_series(f"{path.stem}/{side}" if len(sides) > 1 else path.stem, side, samples) for side in sides]


def _read_episodes(dataset: Dataset) -> list[ForceSeries]:
    """Return the forces of all episodes of a dataset, as `annotate` writes them."""
    features = dataset.info["features"]
    names = [name for name in features if {f"{name}.stddev", f"{name}.valid"} <= features.keys()]
    if not names:
        raise RecordingError(f"{dataset.folder.name}: no forces: no features as force.left and force.left.valid")
    found = []
    for episode in dataset.episodes:
        rows = rows_of(read_parquet(episode.data), episode, dataset.folder.name)
        stamps = np.rint(np.arange(len(rows)) * (NANOSECONDS / float(dataset.info["fps"]))).astype(np.int64)
        for name in names:
            side, values = name.rpartition(".")[2], {}
            valid = np.array(rows[f"{name}.valid"].to_pylist(), bool).reshape(-1, 1)
            for column, end in (("force", ""), ("force_stddev", ".stddev")):
                told = np.array(rows[name + end].to_pylist(), dtype=np.float64).reshape(-1, 3)
                values[column] = np.where(valid, told, np.nan)
            stddev = stddev_along(values["force"], values["force_stddev"])
            case = f"{dataset.folder.name}/episode_{episode.index:06d}/{side}"
            found.append(ForceSeries.build(case, side, stamps, **values, magnitude_stddev=stddev, status=""))
    return found


def _make_series(name: str, side: str, samples: Mapping[str, list[Any]]) -> ForceSeries:
    """Return the series of one jaw."""
    found, stated, true = (_stack(samples.get(f"/{side}/{kind}", [])) for kind in (_FORCE, _STDDEV, _TRUTH))
    stddev = match_truth(stated, found.stamps_ns) if len(stated.stamps_ns) else np.full_like(found.force, np.nan)
    words = {stamp_of(each): each.status[0].values[0].value for each in samples.get(f"/{side}/{_STATUS}", [])}
    status = [words.get(stamp, "") for stamp in found.stamps_ns.tolist()]
    return ForceSeries.build(
        name,
        side,
        found.stamps_ns,
        force=found.force,
        torque=found.torque,
        magnitude_stddev=stddev_along(found.force, stddev),
        true_force=match_truth(true, found.stamps_ns) if len(true.stamps_ns) else None,
        status=np.array(status, dtype="U32"),
    )


def _stack(messages: list[Any]) -> WrenchTrack:
    """Return wrenches as arrays, in the order of their stamps."""
    messages = sorted(messages, key=stamp_of)
    force, torque = (stack_vectors([getattr(each.wrench, name) for each in messages]) for name in ("force", "torque"))
    return WrenchTrack(stamps_ns=np.array([stamp_of(each) for each in messages], np.int64), force=force, torque=torque)
