"""Recordings with forces next to what they held: the same messages, byte for byte, and new topics between them."""

from __future__ import annotations

import argparse
import json
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.files import FileError, check_inside
from finforce.messages import read_stamp
from finforce_eval.annotation.video import write_video
from finforce_eval.errors import OptionError, RecordingError, UnseenError
from finforce_eval.evaluation.at_rest import doubt_intrinsics
from finforce_eval.evaluation.check import explain_camera
from finforce_eval.evaluation.forces import (
    describe_contradictions,
    estimate_forces,
    no_force_reasons,
    share_reached,
    why_unanswered,
)
from finforce_eval.evaluation.gripper import combine_jaws
from finforce_eval.evaluation.keypoint_source import KeypointSource, parse_source
from finforce_eval.evaluation.setup import share_setup
from finforce_eval.evaluation.tare_source import borrow_tares, parse_tare_source
from finforce_eval.evaluation.unseen import describe_unseen, explain_unseen
from finforce_eval.machine import version, without_nan
from finforce_eval.recordings.bags import NO_DIGEST, BagReader, bag_source, is_buffer, is_frames, list_files, open_bag
from finforce_eval.recordings.tracks import Recording
from finforce_eval.recordings.writer import (
    Entry,
    cloud_message,
    force_markers,
    new_folder,
    status_message,
    typestore,
    wrench_message,
)
from finforce_eval.table import AXES, ForceSeries, write_table
from finforce_eval.tasks import Task, hash_settings

GRIPPER_FRAME = "gripper_base"
NOTE, TABLE, VIDEO = "annotation.json", "forces.parquet", "forces.mp4"
FEW = 0.5  # share of the images with a force, below which the camera is judged by the first images
_OK, _WARN = 0, 1


def bag_task(name: str, source: Path, target: Path, options: argparse.Namespace, settings: Mapping[str, Any]) -> Task:
    """Return the task of annotating a bag; only its path is known yet.

    `settings` are what `describe_options` says of the options. Where there is no such recording, the task says so.
    """
    files = list_files(source)
    key = hash_settings({**settings, "episode": options.episode}, files)
    given = {"source": source, "target": target, "options": options, "settings": hash_settings(settings), "key": key}
    files = [*map(Path, settings["files"]), *files]
    return Task(name=name, key=key, work=annotate_bag, given=given, output=str(target), files=files)


def annotate_bag(source: Path, target: Path, options: argparse.Namespace, settings: str, key: str) -> dict[str, Any]:
    """Write a recording with forces and return figures of it; where it is there already, a run was killed after that.

    Args:
        source: rosbag2 folder, .mcap or .db3 file, video, or folder of pictures.
        target: the new folder.
        options: of the command `annotate`.
        settings: hash of them and of the files that they name.
        key: of the task, which is kept next to what was written.

    Raises:
        FinforceError: the recording cannot be read, or no forces be found in it.
        OSError: the folder cannot be written.
    """
    if (done := _read_figures(target, key)) is not None:
        return done
    setup, keypoints = share_setup(settings, options), parse_source(options)
    recording = keypoints.read(source)
    setup.contacts.check(recording)
    recording = replace(recording, name=target.name)
    try:
        recording = keypoints.apply(recording)
    except UnseenError as error:
        why = explain_unseen(recording, keypoints) or explain_camera(recording, keypoints)
        doubts = doubt_intrinsics(recording.images.camera)
        raise RecordingError("; ".join((str(error), *doubts, *why))) from error
    tare = parse_tare_source(options.tare_from)
    other = None if tare is None or tare.episode is None else _read_episode(source, tare.episode, keypoints)
    tares, compared = borrow_tares(tare, recording, other, keypoints, setup)
    jaws = estimate_forces(recording, setup, tares=tares)
    why = why_unanswered(jaws.values())
    notes = [*(describe_unseen(recording, keypoints, jaws) or _explain_few(recording, keypoints, jaws))]
    notes += [*recording.notes, *compared]
    notes += [*setup.contacts.describe_comparison(recording), *describe_contradictions(jaws.values())]
    if why:
        raise RecordingError(f"{target.name}: {'; '.join((*notes, why))}")
    figures = without_nan(_describe(jaws, recording) | {"notes": notes})
    about = {"key": key, "figures": figures, "settings": dict(setup.about), "version": version()}
    try:
        with new_folder(target) as folder:
            if is_frames(source):
                folder.mkdir()
                write_table(folder / TABLE, list(jaws.values()), about)
            else:
                messages = ForceMessages(jaws, combine_jaws(jaws))
                write_annotated(recording, bag_source(recording.source), messages, folder, side_file=options.side_file)
            if options.video:
                write_video(folder / VIDEO, recording, jaws)
            (folder / NOTE).write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
    except (RecordingError, OSError):
        if _read_figures(target, key) is None:  # else a worker that was taken for dead has done the same meanwhile
            raise
    return figures


def _explain_few(recording: Recording, source: KeypointSource, jaws: Mapping[str, ForceSeries]) -> list[str]:
    """Return what is wrong with the camera where few images of a detector have a force; empty if nothing is."""
    few = any(forces.solved.mean() < FEW for forces in jaws.values())
    is_detected = all(track.detection is not None for track in recording.jaws.values())
    return explain_camera(recording, source) if few and is_detected else []


def _read_figures(target: Path, key: str) -> dict[str, Any] | None:
    """Return the figures of a recording that a task with this key has annotated; None where none has."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        note = json.loads((target / NOTE).read_text(encoding="utf-8"))
        return note["figures"] if note["key"] == key else None
    return None


def _read_episode(source: Path, episode: int, keypoints: KeypointSource) -> Recording:
    """Return another episode of a buffer; raises OptionError where a recording is no buffer."""
    if not is_buffer(source):
        raise OptionError(f"--tare-from {episode}: {source.name} has no episodes; expected seconds, as 12.5s")
    return replace(keypoints, choice=replace(keypoints.choice, episode=episode)).read(source)


def _describe(jaws: Mapping[str, ForceSeries], recording: Recording) -> dict[str, Any]:
    """Return what the manifest tells of the forces, and of the key points' quality, for which no labels are needed."""
    sides = {}
    for side, forces in jaws.items():
        words, counts = np.unique(forces.column("status")[~forces.solved], return_counts=True)
        known, residual = bool(forces.solved.any()), forces.column("residual")[forces.solved]
        told = Counter(filter(None, no_force_reasons(forces)))
        residual = residual[np.isfinite(residual)]  # an image of a jaw at rest has none
        sides[side] = {
            "images": len(forces),
            "answered": int(forces.solved.sum()),
            "unanswered": dict(zip(words.tolist(), counts.tolist(), strict=True)),
            "why": told.most_common(1)[0][0] if told else "",
            "largest_N": float(np.nanmax(forces.magnitude)) if known else None,
            "residual_mm": 1e3 * float(np.median(residual)) if len(residual) else None,
            "within_reach": share_reached(forces, recording.jaw(side).detection),
        }
    stamps = np.concatenate([forces.stamps_ns for forces in jaws.values()])
    return {"jaws": sides, "span_s": round(1e-9 * float(np.ptp(stamps)), 3) if len(stamps) else 0.0}


class ForceMessages:
    """Makes the messages of one image after the other; what is not known is NaN, with its reason.

    Args:
        jaws: forces by side.
        grasp: of the gripper.
    """

    def __init__(self, jaws: Mapping[str, ForceSeries], grasp: ForceSeries) -> None:
        self._jaws = {side: _rows(forces, {"reason": no_force_reasons(forces)}) for side, forces in jaws.items()}
        self._grasp = _rows(grasp)
        self._drawn: dict[str, bool] = {}
        names = ("wrench", "wrench_stddev", "wrench_status", "contact", "markers")
        self.topics = {f"/{side}/{name}" for side in jaws for name in names} | {"/grasp_wrench", "/manipulation_wrench"}

    def __len__(self) -> int:
        """Images with messages."""
        return len(self._grasp)

    def at(self, stamp: int) -> Iterator[Entry]:
        """Yield the messages of an image [ns]; none of an image that is not known, or was asked for before."""
        row = self._grasp.pop(stamp, None)
        if row is None:
            return
        for side, rows in self._jaws.items():
            if stamp in rows:
                yield from self._of_jaw(side, rows[stamp], stamp)
        force = np.array([row["grasp_force"], 0.0, 0.0]) + 0.0 * row["grasp_force"]
        grasp = wrench_message(stamp, GRIPPER_FRAME, force, 0.0 * force)
        yield Entry(stamp, "/grasp_wrench", grasp)
        net = wrench_message(stamp, GRIPPER_FRAME, _vector(row, "force"), _vector(row, "torque"))
        yield Entry(stamp, "/manipulation_wrench", net)

    def _of_jaw(self, side: str, row: Mapping[str, Any], stamp: int) -> Iterator[Entry]:
        """Yield the messages of one jaw in one image."""
        frame, force = f"{side}_jaw", _vector(row, "force")
        wrench = wrench_message(stamp, frame, force, _vector(row, "torque"))
        yield Entry(stamp, f"/{side}/wrench", wrench)
        stddev = wrench_message(stamp, frame, _vector(row, "force_stddev"), _vector(row, "torque_stddev"))
        yield Entry(stamp, f"/{side}/wrench_stddev", stddev)
        level = _OK if np.isfinite(force).all() else _WARN
        text, values = row["reason"] or row["status"], {"status": row["status"]}
        message = status_message(stamp, level, f"finforce: {side} jaw", text, values)
        yield Entry(stamp, f"/{side}/wrench_status", message)
        if row["points_x"] is not None:
            columns = {axis: np.asarray(row[f"points_{axis}"], np.float32) for axis in (*AXES, "weight")}
            columns["touching"] = np.full(len(columns["x"]), row["points_touching"], np.uint8)
            yield Entry(stamp, f"/{side}/contact", cloud_message(stamp, frame, columns))
        # an image has another picture than the one before where there is a force, or one has gone
        pressed = bool(np.isfinite(force).all() and force.any())
        before, self._drawn[side] = self._drawn.get(side, False), pressed
        if pressed or before:
            markers = force_markers(stamp, frame, _vector(row, "contact_point"), force)
            yield Entry(stamp, f"/{side}/markers", markers)


def _rows(forces: ForceSeries, more: Mapping[str, Any] | None = None) -> dict[int, dict[str, Any]]:
    """Return the rows of a table, and columns more, by their stamps [ns]."""
    return {row["stamp"]: row for row in forces.table.assign(**(more or {})).to_dict("records")}


def _vector(row: Mapping[str, Any], name: str) -> NDArray[np.float64]:
    """Return a vector (3,) of a row."""
    return np.array([row[f"{name}_{axis}"] for axis in AXES])


def write_annotated(
    recording: Recording, source: Path, forces: ForceMessages, folder: Path, *, side_file: bool = False
) -> None:
    """Write the messages of a bag and those of the forces, or the latter alone, as a new rosbag2 folder.

    New messages follow the first message with their stamp that is of an image or of key points, at its time of receipt.
    Files next to the bag in its own folder, as a `case.json` or the object's mesh, are copied, too.

    Args:
        recording: content of the bag.
        source: the bag, as `bag_source` returned it.
        forces: the new messages.
        folder: to be made; see `new_folder`.
        side_file: leave the bag's own messages out.

    Raises:
        RecordingError: the bag has a topic of the same name.
        OSError: the folder cannot be written, or the disk is full.
    """
    for path in source.iterdir() if source.is_dir() else ():
        try:
            check_inside(path, source)
        except FileError as error:
            raise RecordingError(f"{source.name}: {error}") from error
    with open_bag(source, recording.name) as bag:
        same = sorted(bag.types.keys() & forces.topics)
        if same and not side_file:
            raise RecordingError(
                f"{bag.name}: has {', '.join(same)} already; expected a recording without, or --side-file, which "
                "writes the new messages alone"
            )
        _write(bag, recording, forces, folder, side_file=side_file)
        if len(forces):
            raise RecordingError(f"{recording.name}: the forces of {len(forces)} images are of none in the bag")
        if source.is_dir() and not side_file:
            _copy_others(source, folder)


def _write(bag: BagReader, recording: Recording, forces: ForceMessages, folder: Path, *, side_file: bool) -> None:
    """Copy the bag into a folder that does not exist yet, the forces of an image behind it."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    types, colors = typestore(), {recording.images.topics[0]} if recording.images is not None else set()
    # the topics whose messages have the stamps of the forces
    triggers = (colors | {f"/{side}/keypoints" for side in recording.jaws}) & bag.types.keys()
    path = recording.path
    is_sqlite = path.suffix == ".db3" or (path.is_dir() and not any(path.glob("*.mcap*")) and any(path.glob("*.db3*")))
    plugin = StoragePlugin.SQLITE3 if is_sqlite else StoragePlugin.MCAP
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        known = {} if side_file else {each.id: _copy_connection(writer, each) for each in bag.connections}
        added: dict[str, Any] = {}
        for connection, time, data in bag.messages():
            if not side_file:
                writer.write(known[connection.id], time, data)
            for entry in forces.at(read_stamp(data)) if connection.topic in triggers else ():
                kind = entry.message.__msgtype__
                if entry.topic not in added:
                    added[entry.topic] = writer.add_connection(entry.topic, kind, typestore=types)
                writer.write(added[entry.topic], time, types.serialize_cdr(entry.message, kind))


def _copy_connection(writer: Any, connection: Any) -> Any:
    """Add a topic as it was recorded to a bag that is written."""
    return writer.add_connection(
        connection.topic,
        connection.msgtype,
        msgdef=connection.msgdef.data or "",
        rihs01=connection.digest or NO_DIGEST,
        serialization_format=connection.ext.serialization_format,
        offered_qos_profiles=connection.ext.offered_qos_profiles,
    )


def _copy_others(source: Path, folder: Path) -> None:
    """Copy what lies next to the bag files in their folder."""
    for path in source.iterdir():
        if path.is_file() and path.suffix not in (".mcap", ".db3", ".zstd") and path.name != "metadata.yaml":
            shutil.copy2(path, folder / path.name)
