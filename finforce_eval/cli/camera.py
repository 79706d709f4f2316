"""The subcommand `camera`: pictures of open, unloaded jaws in, a rig file out."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics, project
from finforce.gripper_frames import SIDES, read_extrinsics
from finforce.optional import import_cv2
from finforce.transforms import pose_numbers
from finforce_eval.cli.parser import BAG_HELP, CommandResult, add_rest_options, length_mm
from finforce_eval.errors import OptionError
from finforce_eval.evaluation.check import FITTED, SEEN, draw_jaw, draw_points
from finforce_eval.evaluation.keypoint_source import choose_images, parse_source
from finforce_eval.evaluation.setup import read_recordings
from finforce_eval.recordings.tracks import Recording
from finforce_eval.tasks import progress_bar
from finforce_ifea.jaw.jaw import Jaw, load_jaw
from finforce_keypoints.build import ANY_FINGER
from finforce_keypoints.detectors.side_plane import AnyFinger
from finforce_keypoints.geometry.side_picture import find_side, map_picture, project_plane, take_picture
from finforce_keypoints.geometry.template import draw_template, find_shape, fit_grid
from finforce_keypoints.networks.side_network import SideNetwork
from finforce_keypoints.parameters import NO_DEPTH
from finforce_keypoints.placement import (
    KEPT,
    PLACES,
    POLISHED,
    ROUNDS,
    STARTS,
    STEPS,
    TURN_STDDEV,
    CameraPlacement,
    KnownSizes,
    find_placement,
)
from finforce_keypoints.rig import Rig, RigCamera, describe_mount, write_rig
from finforce_keypoints.tags import FAMILIES, TagFinder, find_tag

PANEL = 560  # [px] height of the picture of each jaw
PICTURES = 4  # of the images, which are compared
GUESS_STDDEV = (5.0, 2.0)  # [mm], [degrees] of a guess of which nothing else is said


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
    text = "standard deviations of the pose given as --extrinsics: position [mm] and direction [degrees] (5 2)"
    parser.add_argument(
        "--extrinsics-stddev", nargs=2, type=float, default=GUESS_STDDEV, metavar=("MM", "DEG"), help=text
    )
    text = "distance of the jaws' inner faces in the picture where they are farthest open [mm]"
    parser.add_argument("--stroke", type=length_mm, metavar="MM", help=text)
    text = "write the rig even if another place explains the pictures alike"
    parser.add_argument("--force", action="store_true", help=text)
    add_rest_options(parser, images=45)


def run(options: argparse.Namespace) -> CommandResult:
    """Find camera, jaws and covered points in the first images of a source, and write and draw them."""
    options.source = "images"
    source = parse_source(options)
    source = replace(source, choice=replace(source.choice, is_cut=True))
    (recording,) = read_recordings(options.bags, source)
    colors = choose_pictures(recording, options.images)
    seen = find_tags(colors, options)
    jaws = {side: load_jaw(options.jaw, side) for side in SIDES if side in recording.jaws}
    locator = AnyFinger(SideNetwork(source.parameters.get("model") or ANY_FINGER), jaws)
    guess = source.node_parameters(recording).get("T_gripper_camera")
    position, direction = options.extrinsics_stddev
    known = KnownSizes(
        guess=None if guess is None else read_extrinsics(guess),
        stddev=np.repeat((1e-3 * position, np.radians(direction)), 3),
        stroke=options.stroke,
        tags=seen,
        tag_size=options.tag_size,
    )
    steps = STARTS + 2 * (KEPT + POLISHED) * STEPS + (PLACES + 1) * STEPS + ROUNDS * len(colors)
    with progress_bar(steps, "step") as bar:
        found = find_placement(colors, recording.images.camera, jaws, locator, known, progress=bar.update)
    found = add_tags(found, seen, recording.images.camera, options)
    output = Path(options.output)
    picture = output.with_suffix(".png")
    import_cv2().imwrite(str(picture), draw_placement(found, colors[0], recording, jaws)[..., ::-1])
    print(describe_placement(found, jaws))
    if not found.is_sure and not options.force:
        raise OptionError(
            "two places explain the pictures alike, no rig is written: "
            f"ribs {found.correlation:.2f}, the next best place tells {found.rival:.0%} of this; see {picture}; give "
            "sharper or more pictures at several openings, --tags, --stroke or --extrinsics, or --force"
        )
    rig = build_rig(found, recording, options.jaw, options.tag_family)
    write_rig(rig, output)
    print(f"Rig: {output}; {picture}: jaws as found in orange, key points seen in green")
    shown = {"correlation": found.correlation, "rival": found.rival, "residual_px": found.residual}
    return CommandResult({"rig": rig.model_dump(mode="json"), **shown})


def choose_pictures(recording: Recording, count: int) -> list[NDArray]:
    """Return some of the first images of a recording, (h, w, 3) each.

    Raises:
        RecordingError: they cannot be read.
        OptionError: there are none.
    """
    images = choose_images(recording, NO_DEPTH) if recording.images is not None else []
    if not len(images):
        raise OptionError(f"{recording.name}: no images; expected pictures of jaws that are open and unloaded")
    first = images.stamps_ns[: min(count, len(images))]
    chosen = np.unique(np.linspace(0, len(first) - 1, PICTURES).round().astype(int))
    return [image.color for _, image in images.at(first[chosen])]


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
    found: CameraPlacement, seen: list[dict[int, NDArray]], camera: CameraIntrinsics, options: argparse.Namespace
) -> CameraPlacement:
    """Return a placement with the tags that the options name, each on the jaw that it is nearer to.

    Raises:
        GeometryError: a tag is seen in no picture, or does not move with a jaw.
        OptionError: two tags are on one jaw.
    """
    mounts = dict(found.mounts)
    for number in options.tags:
        corners = {n: tags[number] for n, tags in enumerate(seen) if number in tags}
        poses = {side: [found.pose(side, n) for n in corners] for side in mounts}
        side, tag = find_tag(number, list(corners.values()), poses, options.tag_size, camera)
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


def describe_placement(found: CameraPlacement, jaws) -> str:
    """Return what was found in words."""
    x, y, z = 1e3 * found.T_gripper_camera[:3, 3]
    lines = [
        f"camera at {x:.1f}, {y:.1f}, {z:.1f} mm of the gripper; ribs {found.correlation:.2f}, the next best place "
        f"tells {found.rival:.0%} of this; {found.residual:.2f} px left over"
    ]
    for side, mount in found.mounts.items():
        seen, count = int(mount.seen_points(jaws[side])[:-1].sum()), len(jaws[side].keypoints)
        turned = ", ".join(f"{angle:.1f}" for angle in np.degrees(mount.turn))
        places = ", ".join(f"{1e3 * origin:.1f}" for origin in found.origins[side])
        tag = "" if mount.tag is None else f", tag {mount.tag.id}"
        lines.append(
            f"{side} jaw: {seen} of {count} key points to be seen, turned by {turned} degrees, at {places} mm{tag}"
        )
    if len(next(iter(found.origins.values()))) == 1:
        lines.append(
            "WARNING: one picture hardly tells the camera's distance and where along the jaws it looks: give images "
            "at several openings"
        )
    askew = [side for side, mount in found.mounts.items() if np.abs(mount.turn).max() > 2.0 * TURN_STDDEV]
    if askew:
        lines.append(
            f"WARNING: {' and '.join(askew)} jaw turned by more than {np.degrees(2.0 * TURN_STDDEV):.1f} degrees, "
            "which few mounts are: check the picture, and give images at several openings or in other light"
        )
    return "\n".join(lines)


def draw_placement(found: CameraPlacement, color: NDArray, recording: Recording, jaws) -> NDArray:
    """Return the first picture, and below it each jaw: enlarged with its key points named, and its side with the ribs.

    Jaws are orange as found, key points green as seen.
    """
    cv2, camera = import_cv2(), recording.images.camera
    panels = [draw_found_jaw(found, color, camera, side, jaws[side]) for side in jaws]
    width = sum(panel.shape[1] for panel in panels)
    larger = width / color.shape[1]
    picture = cv2.resize(color, None, fx=larger, fy=larger, interpolation=cv2.INTER_CUBIC)[:, :width]
    whole = enlarge_camera(camera, np.zeros(2), larger)
    for side, jaw in jaws.items():
        draw_jaw(picture, jaw, found.pose(side, 0), whole, FITTED)
    return np.vstack((picture, np.hstack(panels)))


def draw_found_jaw(
    found: CameraPlacement, color: NDArray, camera: CameraIntrinsics, side: str, jaw: Jaw
) -> NDArray[np.uint8]:
    """Return a jaw enlarged with its ribs and the names of its key points; beside it are its side and the model's."""
    cv2, T, plane, seen = import_cv2(), found.pose(side, 0), find_side(jaw), found.seen[side][0]
    grid = fit_grid(find_shape(jaw))
    corners = grid.places(np.array([[0, 0], [grid.width, 0], [0, grid.height], [grid.width, grid.height]]))
    shown = project_plane(corners, plane, T, camera)
    first = np.clip(np.nanmin(shown, axis=0), 0, (camera.width - 2, camera.height - 2))
    last = np.clip(np.nanmax(shown, axis=0), first + 1, (camera.width, camera.height))
    larger = PANEL / float((last - first).max())
    turned = np.array([[larger, 0.0, -larger * first[0]], [0.0, larger, -larger * first[1]]])
    crop = cv2.warpAffine(color, turned, (PANEL, PANEL), flags=cv2.INTER_CUBIC)
    draw_jaw(crop, jaw, T, enlarge_camera(camera, first, larger), FITTED)
    draw_points(crop, larger * (seen - first), SEEN)
    for name, pixel in zip(jaw.keypoint_names, larger * (seen[:-1] - first), strict=True):
        if np.isfinite(pixel).all():
            write_words(crop, name, pixel + (8.0, 4.0), 0.35)
    tag = found.mounts[side].tag
    if tag is not None:
        draw_points(crop, larger * (project(tag.corners @ T[:3, :3].T + T[:3, 3], camera) - first), FITTED)
    where = "right" if np.nanmean(shown[:, 0]) > 0.5 * camera.width else "left"
    write_words(crop, f"{side}: on the {where} of the picture", np.array([8.0, 20.0]), 0.6)
    view = take_picture(color, map_picture(grid, plane, T, camera))[::-1]
    model = np.repeat(draw_template(find_shape(jaw), grid)[::-1, :, :1], 3, axis=2)
    beside = [cv2.resize(each, (PANEL * 11 // 28, PANEL // 2), interpolation=cv2.INTER_CUBIC) for each in (view, model)]
    return np.hstack((crop, np.vstack(beside)))


def enlarge_camera(camera: CameraIntrinsics, first: NDArray, larger: float) -> CameraIntrinsics:
    """Return the intrinsics of a part of the images that begins at a pixel (2,) and is so many times as large."""
    cx, cy = larger * (np.array([camera.cx, camera.cy]) - first)
    return replace(camera, fx=larger * camera.fx, fy=larger * camera.fy, cx=float(cx), cy=float(cy))


def write_words(picture: NDArray, words: str, place: NDArray, size: float) -> None:
    """Write words into a picture (h, w, 3) at column and row (2,), white on black."""
    cv2, where = import_cv2(), tuple(np.round(place).astype(int).tolist())
    for shade, thickness in ((0, 3), (255, 1)):
        cv2.putText(picture, words, where, cv2.FONT_HERSHEY_SIMPLEX, size, (shade,) * 3, thickness, cv2.LINE_AA)
