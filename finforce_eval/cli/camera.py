"""The subcommand `camera`: pictures of open, unloaded jaws in, a rig file out."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, project
from finforce.gripper_frames import SIDES, read_extrinsics
from finforce.rig import Rig, RigCamera, RigJaw, RigTag, write_rig
from finforce.transforms import pose_numbers
from finforce_eval.cli.parser import BAG_HELP, CommandResult, add_rest_options, length_mm
from finforce_eval.errors import OptionError, UnseenError
from finforce_eval.evaluation.at_rest import OFTEN
from finforce_eval.evaluation.check import FITTED, SEEN, draw_jaw, draw_points
from finforce_eval.evaluation.keypoint_source import (
    KeypointSource,
    build_records,
    choose_images,
    detect_keypoints,
    parse_source,
    spread,
)
from finforce_eval.evaluation.setup import read_recordings
from finforce_eval.recordings.tracks import Recording
from finforce_eval.tasks import progress_bar
from finforce_ifea.jaw.jaw import load_jaw
from finforce_keypoints.build import ANY_FINGER
from finforce_keypoints.detectors.side_plane import AnyFinger
from finforce_keypoints.errors import GeometryError
from finforce_keypoints.networks.side_network import SideNetwork
from finforce_keypoints.parameters import NO_DEPTH, REFERENCE, JawMount
from finforce_keypoints.placement import (
    LEAST_SEEN,
    TURN_STDDEV,
    CameraPlacement,
    PlacementTask,
    count_steps,
    find_placement,
)
from finforce_keypoints.rib_check import describe_ribs
from finforce_keypoints.tags import FAMILIES, TagFinder, find_tag

PICTURES = 4  # of the images, which are compared
MOST_TURNED = np.sqrt(11.3) * TURN_STDDEV  # [rad] 99 % of mounts, by chi square of three turns
LEAST_SURE = np.array([8e-3, 0.06])  # standard deviations of a rig: a rib along the finger [m], size [-]
FARTHEST_TAG = 0.02  # [m] across the side of its jaw, which holders are not
TRIED = 10  # of the images, in which the detector has to find the jaws with the rig


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument("bags", nargs=1, metavar="SOURCE", help=BAG_HELP)
    text = "intrinsics of the camera, as --intrinsics; of larger images the middle, scaled, is taken"
    parser.add_argument("--lens", dest="intrinsics", nargs="+", metavar="FILE", help=text)
    parser.add_argument("-o", "--output", default="rig.yaml", metavar="FILE", help="rig file (rig.yaml)")
    text = "numbers of the tags on the holders, which then tell where the jaws are under load"
    parser.add_argument("--tags", nargs="+", type=int, default=[], metavar="ID", help=text)
    text = "length of an edge of these tags' black square [mm] (16)"
    parser.add_argument("--tag-size", type=length_mm, default=0.016, metavar="MM", help=text)
    parser.add_argument("--tag-family", default=FAMILIES[0], choices=FAMILIES, help="family of the tags (4x4_50)")
    text = "standard deviations of --extrinsics: position [mm] and direction [degrees] (5 2)"
    parser.add_argument(
        "--extrinsics-stddev", nargs=2, type=positive, default=(5.0, 2.0), metavar=("MM", "DEG"), help=text
    )
    text = "gap between the inner faces of both jaws where they are widest open in the images [mm]"
    parser.add_argument("--opening", type=length_mm, metavar="MM", help=text)
    text = "write the rig even if its ribs are not where they should be, or may be elsewhere"
    parser.add_argument("--force", action="store_true", help=text)
    add_rest_options(parser, images=45)


def positive(text: str) -> float:
    """Return an option that is a positive number."""
    value = float(text)
    if not 0.0 < value < np.inf:
        raise argparse.ArgumentTypeError(f"{text}: expected a positive number")
    return value


def run(options: argparse.Namespace) -> CommandResult:
    """Find camera, jaws and covered points in the first images of a source, and write and draw them."""
    from finforce.optional import import_cv2

    options.source = "images"
    source = parse_source(options)
    source = replace(source, choice=replace(source.choice, is_cut=True))
    (recording,) = read_recordings(options.bags, source)
    colors = choose_pictures(recording, options.images)
    seen = find_tags(colors, options)
    jaws = {side: load_jaw(options.jaw, side) for side in SIDES if side in recording.jaws}
    task = PlacementTask(
        images=colors,
        camera=recording.images.camera,
        jaws=jaws,
        locator=AnyFinger(SideNetwork(source.parameters.get("model") or ANY_FINGER), jaws),
        opening=options.opening,
    )
    guess = source.node_parameters(recording).get("T_gripper_camera")
    guess = None if guess is None else read_extrinsics(guess)
    with progress_bar(count_steps(len(colors), guess is not None), "step") as bar:
        stddev = np.repeat((1e-3, np.radians(1.0)) * np.array(options.extrinsics_stddev), 3)
        found = find_placement(task, guess, stddev, progress=bar.update)
    found = add_tags(found, seen, recording.images.camera, jaws, options)
    output = Path(options.output)
    picture = output.with_suffix(".png")
    import_cv2().imwrite(str(picture), draw_placement(found, colors[0], recording, jaws)[..., ::-1])
    print(describe_placement(found, jaws))
    rig = build_rig(found, recording, options.jaw, options.tag_family)
    doubts = describe_ribs(found.ribs) or describe_unsure(found) or try_rig(rig, recording, source, options.images)
    refuse_doubts(doubts, options, picture)
    write_rig(rig, output)
    for doubt in doubts:
        print(f"WARNING: {doubt}")
    print(f"Rig: {output}; {picture}: jaws as found in orange, key points seen in green")
    return CommandResult(
        {
            "rig": rig.model_dump(mode="json"),
            "contrast": found.contrast,
            "residual_px": found.residual,
            "ribs": {side: each.here.ribs for side, each in found.ribs.items()},
            "margin": {side: each.margin for side, each in found.ribs.items()},
        }
    )


def refuse_doubts(doubts: Sequence[str], options: argparse.Namespace, picture: Path) -> None:
    """Refuse a placement that something speaks against, unless the options force it.

    Raises:
        GeometryError: something does.
    """
    if doubts and not options.force:
        raise GeometryError(
            f"{'; '.join(doubts)}. No rig is written, see {picture}: give sharper pictures, at several openings, the "
            "intrinsics of their lens setting, a better --extrinsics, --opening, or --force"
        )


def describe_unsure(found: CameraPlacement) -> list[str]:
    """Return in words which jaws are turned as no mount is, or may be anywhere, by how sure their places are."""
    turned = {side: float(np.linalg.norm(mount.turn)) for side, mount in found.mounts.items()}
    strange = [
        f"the {side} jaw comes out turned by {np.degrees(turn):.0f} degrees"
        for side, turn in turned.items()
        if turn > MOST_TURNED
    ]
    return strange or [
        f"the {side} jaw's place is only known to {1e3 * mount.stddev[0]:.0f} mm and "
        f"{100.0 * mount.stddev[1]:.0f} % in size (one standard deviation)"
        for side, mount in found.mounts.items()
        if (np.array(mount.stddev) > LEAST_SURE).any()
    ]


def try_rig(rig: Rig, recording: Recording, source: KeypointSource, count: int) -> list[str]:
    """Return which jaws the detector does not find with a rig in most of the pictures that it was made from, in words.

    Args:
        rig: just made.
        recording: with these pictures.
        source: the detector's other parameters.
        count: the first so many images show open, unloaded jaws.

    Raises:
        FinforceError: the detector cannot be built, or an image is damaged.
    """
    source = replace(source, jaw_file=rig.jaw, parameters={**source.parameters, **rig.detector_parameters()})
    images = choose_images(recording, build_records(source.node_parameters(recording)).parameters.depth)
    recording = replace(recording, images=images.at(spread(images.stamps_ns[:count], TRIED)))
    try:
        with progress_bar(len(recording.images), "image") as bar:
            found = detect_keypoints(recording, source.build(recording), stills=True, progress=bar.update)
    except UnseenError as error:
        return [f"with this rig the detector finds no jaw in these pictures: {error}"]
    seen = {side: track.detection.accepted.sum(axis=1) >= LEAST_SEEN for side, track in found.jaws.items()}
    few = {side: images for side, images in seen.items() if images.mean() < OFTEN}
    words = "with this rig the detector finds the {} jaw in {} of {} of these pictures"
    return [words.format(side, images.sum(), len(images)) for side, images in few.items()]


def choose_pictures(recording: Recording, count: int) -> list[NDArray]:
    """Return some of the first images of a recording, (h, w, 3) each.

    Raises:
        RecordingError: they cannot be read.
        OptionError: there are none.
    """
    images = choose_images(recording, NO_DEPTH) if recording.images is not None else []
    if not len(images):
        raise OptionError(f"{recording.name}: no images; expected pictures of jaws that are open and unloaded")
    return [image.color for _, image in images.at(spread(images.stamps_ns[:count], PICTURES))]


def find_tags(colors: list[NDArray], options: argparse.Namespace) -> list[dict[int, NDArray]]:
    """Return the corners (4, 2) [px] by number of the tags that the options name, in each of some pictures.

    Raises:
        OptionError: the pictures are mirrored, or a tag is in none of them.
    """
    if not options.tags:
        return []
    finder, seen, mirrored = TagFinder(options.tag_family, options.tags), [], False
    for color in colors:
        finder.reset()
        seen.append(finder.find(color))
        mirrored |= bool(finder.mirrored)
    if mirrored and not any(seen):
        raise OptionError("the pictures are mirrored: their tags decode only when they are flipped")
    there = {number for tags in seen for number in tags}
    if missing := sorted(set(options.tags) - there):
        anything = TagFinder(options.tag_family)
        others = sorted({number for color in colors for number in anything.find(color)} - set(options.tags))
        raise OptionError(
            f"tag {', '.join(map(str, missing))} is in none of the {len(colors)} pictures; of {options.tag_family} "
            f"they show {', '.join(map(str, sorted(there) + others)) or 'none'}: give these numbers, another "
            "--tag-family, or sharper pictures"
        )
    return seen


def add_tags(
    found: CameraPlacement, seen: list[dict[int, NDArray]], camera: CameraIntrinsics, jaws, options: argparse.Namespace
) -> CameraPlacement:
    """Return a placement with the tags that the options name, each on the jaw that it is nearer to.

    Raises:
        GeometryError: a tag is seen in no picture, does not move with a jaw, or is far from its side.
        OptionError: two tags are on one jaw.
    """
    mounts = dict(found.mounts)
    for number in options.tags:
        corners = {n: tags[number] for n, tags in enumerate(seen) if number in tags}
        poses = {side: [found.pose(side, n) for n in corners] for side in mounts}
        side, tag = find_tag(number, list(corners.values()), poses, options.tag_size, camera)
        beyond = float(jaws[side].keypoints[:, 1].mean()) - float(np.median(tag.corners[:, 1]))
        if abs(beyond) > FARTHEST_TAG:
            raise GeometryError(
                f"tag {number} lies {1e3 * abs(beyond):.0f} mm {'behind' if beyond > 0.0 else 'in front of'} the side "
                f"of the {side} jaw: expected {1e3 * FARTHEST_TAG:g} mm at most; is the edge of its black square "
                f"{1e3 * options.tag_size:g} mm long, as --tag-size says?"
            )
        if mounts[side].tag is not None:
            raise OptionError(
                f"tags {mounts[side].tag.id} and {number} are both on the {side} jaw; expected one on each"
            )
        mounts[side] = replace(mounts[side], tag=tag)
    return replace(found, mounts=mounts)


def build_rig(found: CameraPlacement, recording: Recording, jaw: str, family: str) -> Rig:
    """Return the rig of what was found."""
    camera = recording.images.camera
    names = load_jaw(jaw).keypoint_names
    halves = [abs(origins).mean() for origins in found.origins.values()]
    intrinsics = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy", "model")}
    return Rig(
        jaw=str(Path(jaw).resolve()) if Path(jaw).is_file() else jaw,
        camera=RigCamera(**intrinsics, distortion=tuple(camera.distortion.tolist())),
        T_gripper_camera=tuple(round(float(number), 7) for number in pose_numbers(found.T_gripper_camera)),
        likelihood_odds=round(next(iter(found.mounts.values())).odds, 1),
        tag_family=family,
        half_opening=round(float(np.mean(halves)), 5),
        **{side: describe_mount(mount, names) for side, mount in found.mounts.items()},
    )


def describe_mount(mount: JawMount, names: tuple[str, ...]) -> RigJaw:
    """Return how a jaw with key points of some names is mounted."""
    covered = tuple(name for name in (*names, REFERENCE) if name in mount.covered)
    tag = mount.tag and RigTag(id=mount.tag.id, corners=mount.tag.corners.round(5).tolist())
    turn, stddev = (tuple(round(float(number), 5) for number in each) for each in (mount.turn, mount.stddev))
    return RigJaw(turn=turn, covered=covered, tag=tag, stddev=stddev)


def describe_placement(found: CameraPlacement, jaws) -> str:
    """Return what was found in words."""
    x, y, z = 1e3 * found.T_gripper_camera[:3, 3]
    lines = [
        f"camera at {x:.1f}, {y:.1f}, {z:.1f} mm of the gripper; outlines {found.contrast:.2f}, "
        f"{found.residual:.2f} px left over"
    ]
    for side, mount in found.mounts.items():
        seen, count = int(mount.seen_points(jaws[side])[:-1].sum()), len(jaws[side].keypoints)
        turned = ", ".join(f"{angle:.1f}" for angle in np.degrees(mount.turn))
        places = ", ".join(f"{1e3 * origin:.1f}" for origin in found.origins[side])
        tag = "" if mount.tag is None else f", tag {mount.tag.id}"
        if side in found.ribs:
            tag += f"; ribs {found.ribs[side].here.ribs:.2f}, evidence {found.ribs[side].margin:+.2f} over other places"
        lines.append(
            f"{side} jaw: {seen} of {count} key points to be seen, turned by {turned} degrees, at {places} mm{tag}; "
            f"± {1e3 * mount.stddev[0]:.1f} mm along the finger, ± {100.0 * mount.stddev[1]:.1f} % in size"
        )
    if len(next(iter(found.origins.values()))) == 1:
        lines.append(
            "WARNING: one picture hardly tells the camera's distance and where along the jaws it looks: give images "
            "at several openings, or --opening"
        )
    askew = [side for side, mount in found.mounts.items() if np.abs(mount.turn).max() > 2.0 * TURN_STDDEV]
    if askew:
        lines.append(
            f"WARNING: {' and '.join(askew)} jaw turned by more than {np.degrees(2.0 * TURN_STDDEV):.1f} degrees, "
            "which few mounts are: check the picture, and give images at several openings or in other light"
        )
    return "\n".join(lines)


def draw_placement(found: CameraPlacement, color: NDArray, recording: Recording, jaws) -> NDArray:
    """Return the first picture with the jaws as found and the points seen."""
    picture = color.copy()
    for side, jaw in jaws.items():
        draw_jaw(picture, jaw, found.pose(side, 0), recording.images.camera, FITTED)
        draw_points(picture, found.seen[side][0], SEEN)
        if (tag := found.mounts[side].tag) is not None:
            T = found.pose(side, 0)
            draw_points(picture, project(tag.corners @ T[:3, :3].T + T[:3, 3], recording.images.camera), FITTED)
    return picture
