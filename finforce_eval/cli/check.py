"""The subcommand `check`: do camera, jaw file, extrinsics and picture fit each other, before any force."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from finforce.camera_topics import COLOR_TOPIC, COMPRESSED_COLOR, DEPTH_TOPIC, INFO_TOPIC
from finforce.messages import read_stamp
from finforce.optional import import_cv2, import_ros
from finforce_contact.mesh.object_mesh import UNITS
from finforce_eval.cli.extrinsics import read_at_rest
from finforce_eval.cli.parser import BAG_HELP, CommandResult, add_rest_options
from finforce_eval.errors import OptionError, RecordingError
from finforce_eval.evaluation.at_rest import ROUNDS
from finforce_eval.evaluation.check import FAULT, WARNING, Finding, check_object, check_recording, check_rig
from finforce_eval.evaluation.setup import read_recordings
from finforce_eval.recordings.bags import COMPRESSED
from finforce_eval.recordings.images import CAMERA_INFO, IMAGE
from finforce_eval.recordings.writer import Entry, typestore, write_entries
from finforce_eval.tasks import progress_bar
from finforce_keypoints.geometry.jaw_localizer import DEPTH_WORDS

PICTURE = "check.png"
TIMEOUT = 15.0  # [s] after which no more images are waited for
MORE = 2  # images beyond those wanted, whose depth may not have come


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument("bags", nargs="*", metavar="BAG", help=f"{BAG_HELP}, with images")
    text = (
        "check a running camera instead: its usual topics, or the given topics of colour images, camera_info and, "
        "if available, aligned depth"
    )
    parser.add_argument("--topics", nargs="*", metavar="TOPIC", help=text)
    add_rest_options(parser, images=30)
    text = "compare this mesh, in the recorded object poses, with the depth images (the mesh that case.json names)"
    parser.add_argument("--object", metavar="MESH", help=text)
    parser.add_argument("--object-unit", default="m", choices=tuple(UNITS), help="unit of the mesh (m)")
    parser.add_argument("--report", default=".", metavar="DIR", help=f"folder for {PICTURE} (current folder)")


def run(options: argparse.Namespace) -> CommandResult:
    """Check the first images of a recording, print what fits and what does not, and draw it.

    Returns:
        The findings; status 0 if everything fits, 1 if something has to be changed.
    """
    with TemporaryDirectory() as scratch:
        if options.topics is not None:
            if options.bags or len(options.topics) not in (0, 2, 3):
                raise OptionError(
                    f"--topics {' '.join(options.topics)}: expected none, or those of colour, camera_info and perhaps "
                    "depth; and no BAG"
                )
            topics = options.topics or (COLOR_TOPIC, INFO_TOPIC, DEPTH_TOPIC)
            options.bags += [str(record_camera(topics, options.images, Path(scratch) / "camera"))]
        if len(options.bags) != 1:
            raise OptionError(f"got {' '.join(options.bags) or 'nothing'}; expected one BAG, or --topics")
        return _check(options)


def record_camera(topics: Sequence[str], count: int, folder: Path, domain: int | None = None) -> Path:
    """Listen to a camera until `count` images have come, and write them as a rosbag2 folder under usual names.

    Args:
        topics: of colour, camera_info and perhaps depth, which is not waited for.
        count: of images.
        folder: a new one.
        domain: ROS_DOMAIN_ID; None for that of the environment.

    Raises:
        RecordingError: images or intrinsics do not come; the message says which topics do.
        MissingDependencyError: ROS is not there.
    """
    listen = import_ros("finforce.ros.monitor", "listening to topics").listen
    color, info = topics[:2]
    is_packed = color.endswith(COMPRESSED_COLOR)
    kinds = dict(zip(topics, (COMPRESSED if is_packed else IMAGE, CAMERA_INFO, IMAGE), strict=False))
    heard, published = listen(kinds, lambda heard: len(heard[color]) >= count + MORE and heard[info], TIMEOUT, domain)
    if not heard[info] or len(heard[color]) < count:
        there = ", ".join(name for name, types in published.items() if {IMAGE, COMPRESSED} & set(types))
        raise RecordingError(
            f"{len(heard[color])} images on {color} and {len(heard[info])} camera_info on {info}; expected {count} and "
            f"1 within {TIMEOUT:g} s; images are published on {there or 'no topic at all'}"
        )
    usual = (COLOR_TOPIC + (COMPRESSED_COLOR if is_packed else ""), INFO_TOPIC, DEPTH_TOPIC)
    names, decode = dict(zip(topics, usual, strict=False)), typestore().deserialize_cdr
    entries = [
        Entry(read_stamp(data), names[topic], decode(data, kinds[topic]))
        for topic, messages in heard.items()
        for data in (messages[-1:] if topic == info else messages)
    ]
    return write_entries(sorted(entries, key=lambda entry: entry.stamp), folder)


def _check(options: argparse.Namespace) -> CommandResult:
    source, recording = read_at_rest(options)
    with progress_bar(ROUNDS * len(recording.images), "image") as bar:
        found, picture = check_recording(recording, source, bar.update)
    if any(line.text.startswith(DEPTH_WORDS) for line in found):
        found.append(Finding(WARNING, "the object's mesh is not compared with a depth that is wrong"))
    else:
        found += check_object(*read_recordings(options.bags, source), options.object, options.object_unit)
    if options.rig is not None:
        found += check_rig(recording, source)
    for line in found:
        print(f"{line.severity:<8}{line.text}")
    folder = Path(options.report)
    folder.mkdir(parents=True, exist_ok=True)
    import_cv2().imwrite(str(folder / PICTURE), picture[..., ::-1])
    faults, warnings = (sum(line.severity == kind for line in found) for kind in (FAULT, WARNING))
    outcome = "nothing contradicts, with the warnings above" if warnings else "everything fits"
    outcome = f"{faults} to be changed" if faults else outcome
    print(f"{outcome}; {folder / PICTURE}: grey as given, orange as fitted, green key points")
    findings = [line._asdict() for line in found]
    return CommandResult({"faults": faults, "findings": findings}, status=int(faults > 0))
