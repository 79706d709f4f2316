"""The check that camera, jaw file, extrinsics and picture fit each other, before any force is believed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from finforce.camera import EQUIDISTANT, CameraIntrinsics, ImageError
from finforce.errors import FinforceError, one_line
from finforce.gripper_frames import HALF_TURN, OpeningRange, jaw_in_camera
from finforce.optional import import_cv2
from finforce.transforms import invert_pose, pose_numbers, rotation_between
from finforce_contact.mesh.object_mesh import load_object_mesh
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.at_rest import JawsAtRest, approach, doubt_intrinsics, doubt_lens
from finforce_eval.evaluation.contact_source import OUTLINED, UNCOMPARED, UNSEEN, check_mesh
from finforce_eval.evaluation.keypoint_source import KeypointSource, build_records, choose_images, spread
from finforce_eval.evaluation.unseen import explain_unseen
from finforce_eval.recordings.frames import STILL_RATE, FrameImages
from finforce_eval.recordings.objects import find_mesh
from finforce_eval.recordings.tracks import Recording
from finforce_ifea.jaw.jaw import Jaw, list_shipped_jaws, load_jaw
from finforce_keypoints.errors import KeypointError
from finforce_keypoints.geometry.extrinsics import Extrinsics
from finforce_keypoints.geometry.jaw_localizer import DEPTH_OFF, describe_depth
from finforce_keypoints.geometry.side_picture import find_side, project_plane
from finforce_keypoints.geometry.template import find_shape
from finforce_keypoints.images import RgbdImage
from finforce_keypoints.parameters import NO_DEPTH, find_mounts
from finforce_keypoints.picture_change import STEADY
from finforce_keypoints.rib_check import compare_rig, describe_ribs

OK, WARNING, FAULT = "ok", "warning", "fault"
DARK = 25.0  # of 255, least mean brightness
BRIGHT = 235.0  # of 255, greatest mean brightness
BLURRED = 0.16  # share of the finest detail in that of the next scale, of a picture out of focus
COVERED = 0.30  # share of the picture's parts without any detail, from which on something may cover the lens
FLAT = 1.5  # of 255, contrast of a part without detail
BLACK, BAR = 12.0, 0.03  # of 255, brightest pixel of black rows; share of the picture from which on they are a bar
TILES = 12  # parts along each side of the image
GOOD_RESIDUAL = 1.0  # [px] left over when jaws at rest are laid on what is seen
FAR = 3e-3  # [m], tolerated error of the stated camera position
TURNED = np.radians(1.5)  # [rad], tolerated error of the stated camera rotation
# Share of a jaw's key points that have to be seen for another reading to be named: pictures of fingers that are none of
# the known ones show at most 0.75 of a wrong one's.
ENOUGH = 0.8
RIG_PICTURES = 4  # of the images, in which the ribs are compared with a rig
AT_REST = 10  # images in which a camera elsewhere is looked for


class Finding(NamedTuple):
    """One thing that a check found: how bad it is, and what it is."""

    severity: str
    text: str


def check_recording(
    recording: Recording, source: KeypointSource, progress: Callable[[int], Any] = lambda images: None
) -> tuple[list[Finding], NDArray]:
    """Return whether the images of jaws at rest show what camera, jaw file and extrinsics say, and draw it.

    Args:
        recording: with images of jaws that are open, still and unloaded.
        source: the detector's parameters, the jaw file among them.
        progress: called with the number of images done since its last call.

    Returns:
        The findings, and the mean image (h, w, 3) uint8 with what was expected (grey) and what was found.

    Raises:
        FinforceError: an image is damaged, or the detector cannot be built.
    """
    parameters = build_records(source.node_parameters(recording)).parameters
    images = replace(choose_images(recording, parameters.depth), depth_scale=parameters.depth_scale)
    recording = replace(recording, images=images)
    mean = _mean_image(recording)
    findings = [*_describe_camera(recording, parameters.depth), *judge_picture(mean.color)]
    jaws = {side: load_jaw(source.jaw_file, side) for side in recording.jaws}
    try:
        found, look = approach(recording, source, jaws, parameters.camera_pose, progress)
    except (RecordingError, KeypointError, ImageError) as error:
        findings.append(Finding(FAULT, f"no jaw to rely on: {one_line(error)}"))
        findings += _find_reasons(mean, source, recording, parameters.camera_pose)
        return findings, _draw(mean, jaws, parameters.camera_pose, None, None)
    for side, jaw in look.jaws.items():
        seen = np.isfinite(jaw.pixels).all(axis=1)
        findings.append(Finding(OK, f"{side} jaw: {seen.sum()} of {len(seen)} key points seen"))
    findings.append(_judge_camera(found, recording, source, parameters.camera_pose))
    if abs(look.depth_ratio - 1.0) > DEPTH_OFF:
        findings.append(Finding(FAULT, describe_depth(look.depth_ratio)))
    if found.residual > GOOD_RESIDUAL:
        findings += _find_reasons(mean, source, recording, parameters.camera_pose)
    return findings, _draw(mean, jaws, parameters.camera_pose, found, look)


def explain_camera(recording: Recording, source: KeypointSource) -> list[str]:
    """Return where the camera is, in a sentence, if the first images show the jaws at rest but not where it says."""
    parameters = build_records(source.node_parameters(recording)).parameters
    images = choose_images(recording, parameters.depth)
    first = replace(recording, images=images.at(images.stamps_ns[:AT_REST]))
    jaws = {side: load_jaw(source.jaw_file, side) for side in recording.jaws}
    try:
        found, _ = approach(first, source, jaws, parameters.camera_pose)
    except FinforceError:
        return []
    judged = _judge_camera(found, first, source, parameters.camera_pose)
    return [judged.text] if judged.severity == FAULT else []


def check_object(recording: Recording, object_file: str | None, unit: str) -> list[Finding]:
    """Return whether the images show the mesh of the object where its poses say; empty without a mesh.

    Raises:
        FinforceError: the mesh or an image cannot be used.
    """
    path = find_mesh(recording, object_file)
    if path is None:
        return []
    mesh = load_object_mesh(path, unit=unit)
    check = check_mesh(recording, mesh, at_once=True)
    if check is None or not check.is_sure:
        return [Finding(WARNING, f"{mesh.name} {UNCOMPARED}")]
    said = check.at(int(recording.images.stamps_ns[-1]))
    if not check.sees_mesh:
        return [Finding(FAULT, f"{mesh.name} {UNSEEN}")]
    if not said and not recording.images.has_depth:
        return [Finding(WARNING, f"{mesh.name} {OUTLINED}")]
    return [Finding(FAULT, said) if said else Finding(OK, f"{mesh.name} is where the camera sees it")]


def check_rig(recording: Recording, source: KeypointSource) -> list[Finding]:
    """Return whether the ribs in a few images are where a rig has them.

    Args:
        recording: with images of jaws that are open and unloaded, best others than those that the rig was made from.
        source: the detector's parameters, those of the rig among them.
    """
    records = build_records(source.node_parameters(recording))
    images = choose_images(recording, NO_DEPTH)
    jaws = {side: load_jaw(source.jaw_file, side) for side in recording.jaws}
    compared = compare_rig(
        jaws,
        [image.color for _, image in images.at(spread(images.stamps_ns, RIG_PICTURES))],
        images.camera,
        records.parameters.camera_pose,
        find_mounts(records.parameters, jaws),
        OpeningRange(nearest=records.settings.opening_min, farthest=records.settings.opening_max),
    )
    shown = ", ".join(f"{side} {each.here.ribs:.2f}" for side, each in compared.items())
    if said := describe_ribs(compared):
        again = "make the rig anew with finforce camera, or give sharp pictures of open, unloaded jaws"
        return [Finding(FAULT, f"{words}: {again}") for words in said]
    return [Finding(OK, f"the ribs are where the rig has them: correlation {shown}")]


def judge_picture(color: NDArray) -> list[Finding]:
    """Return what speaks against a picture (h, w, 3) uint8, best a mean of many: light, focus, something before it."""
    grey = import_cv2().cvtColor(color, import_cv2().COLOR_RGB2GRAY).astype(np.float32)
    findings, level, sharpness = [], float(grey.mean()), measure_sharpness(grey)
    if not DARK <= level <= BRIGHT:
        text = f"mean brightness {level:.0f} of 255; expected {DARK:g} to {BRIGHT:g}: more or less light"
        findings.append(Finding(WARNING, text))
    if sharpness < BLURRED:
        text = f"out of focus: fine detail {sharpness:.2f} of coarse; expected {BLURRED:g}: focus the lens"
        findings.append(Finding(FAULT, text))
    tiles = [part for row in np.array_split(grey, TILES) for part in np.array_split(row, TILES, axis=1)]
    flat = 100.0 * np.mean([part.std() < FLAT for part in tiles])
    if flat > 100.0 * COVERED:
        text = f"{flat:.0f} % of the image are empty: is the lens partly covered?"
        findings.append(Finding(WARNING, text))
    findings += _find_bars(grey)
    return findings or [Finding(OK, f"brightness {level:.0f} of 255, fine detail {sharpness:.2f} of coarse")]


def _find_bars(grey: NDArray) -> Iterator[Finding]:
    """Yield where a picture (h, w) was padded with black to another shape."""
    for lines, centre, brightest in (("rows", "cy", grey.max(axis=1)), ("columns", "cx", grey.max(axis=0))):
        lit = np.flatnonzero(brightest > BLACK)
        before, after = (lit[0], len(brightest) - 1 - lit[-1]) if len(lit) else (0, 0)
        if max(before, after) > BAR * len(brightest):
            yield Finding(
                WARNING,
                f"black bars of {before} and {after} {lines}: the intrinsics have to be those of the picture with its "
                f"bars, {centre} {before} px more than without",
            )


def measure_sharpness(grey: NDArray) -> float:
    """Return the finest detail of a picture (h, w) float32 over that of the next scale [-], where there is some."""
    cv2 = import_cv2()
    first, second = (cv2.GaussianBlur(grey, (0, 0), sigma) for sigma in (0.8, 2.4))
    fine, coarse = np.abs(grey - first), np.abs(first - second)
    edges = coarse >= np.quantile(coarse, 0.9)
    return float(fine[edges].mean() / max(float(coarse[edges].mean()), 1e-6))


def _mean_image(recording: Recording) -> RgbdImage:
    """Return the mean of the images, without depth."""
    total, count, last = None, 0, None
    for _, image in recording.images:
        total = image.color.astype(np.float64) if total is None else total + image.color
        count, last = count + 1, image
    return replace(last, color=np.round(total / count).astype(np.uint8), depth=None)


def _describe_camera(recording: Recording, depth: str) -> Iterator[Finding]:
    """Yield what the camera is."""
    camera, images = recording.images.camera, recording.images
    across = 2.0 * np.degrees(np.arctan(0.5 * camera.width / camera.fx))
    if camera.model == EQUIDISTANT:
        across = np.degrees(camera.width / camera.fx)
    rate = (len(images) - 1) / max(1e-9 * float(images.stamps_ns[-1] - images.stamps_ns[0]), 1e-6)
    kind = "with depth" if images.has_depth and depth != NO_DEPTH else "colour alone"
    yield Finding(
        OK, f"camera {camera.width}x{camera.height}, {camera.model}, {across:.0f} degrees, {rate:.0f} Hz, {kind}"
    )
    yield from (Finding(WARNING, text) for text in doubt_intrinsics(camera))


def _judge_camera(found: Extrinsics, recording: Recording, source: KeypointSource, guess: NDArray) -> Finding:
    """Return how the camera's pose by what is seen compares with the one given, or that its lens is another one."""
    judged = _judge_pose(found, guess)
    doubts = [] if judged.severity == OK else doubt_lens(found, recording, source, guess)
    return Finding(FAULT, doubts[0]) if doubts else judged


def _judge_pose(found: Extrinsics, guess: NDArray) -> Finding:
    """Return how the camera's pose by what is seen compares with the one given."""
    moved = float(np.linalg.norm(found.T_gripper_camera[:3, 3] - guess[:3, 3]))
    turned = rotation_between(guess, found.T_gripper_camera)
    shown = f"{1e3 * moved:.1f} mm and {np.degrees(turned):.2f} degrees"
    if found.residual > GOOD_RESIDUAL:
        return Finding(
            FAULT,
            f"key points lie {found.residual:.2f} px off the jaw file, wherever the camera is; expected at most "
            f"{GOOD_RESIDUAL:g} px: another finger, a bent one, or other intrinsics",
        )
    if moved > FAR or turned > TURNED:
        numbers = ", ".join(f"{number:.6f}" for number in pose_numbers(found.T_gripper_camera))
        text = f"the camera is {shown} from where T_gripper_camera says; set T_gripper_camera: [{numbers}]"
        return Finding(FAULT, text)
    return Finding(OK, f"extrinsics within {shown}, {found.residual:.2f} px left over")


def _find_reasons(mean: RgbdImage, source: KeypointSource, recording: Recording, guess: NDArray) -> list[Finding]:
    """Return by which other reading of picture, extrinsics or jaw file the key points lie as the jaw file says.

    That a network likes a picture, as it does some that show no finger, is no reason.
    """
    for readings in (_other_poses(guess, source.jaw_file), _other_fingers(guess, source.jaw_file)):
        residual, words = min((_misfit(recording, source, mean, *reading), text) for text, *reading in readings)
        if residual <= GOOD_RESIDUAL:
            return [Finding(FAULT, f"the jaws show, {residual:.2f} px left over, if {words}")]
    return [
        *(Finding(FAULT, text) for text in explain_unseen(recording, source, pictures=STEADY)),
        Finding(
            WARNING,
            "none of the known fingers; no better with other conventions of the extrinsics: are the jaws in view, lit, "
            "and within some 15 mm of where the extrinsics say?",
        ),
    ]


def _misfit(recording: Recording, source: KeypointSource, image: RgbdImage, pose: NDArray, jaw_file: str) -> float:
    """Return what is left over [px] once the jaws are laid on their key points; infinite where few are seen."""
    jaws = {side: load_jaw(jaw_file, side) for side in recording.jaws}
    here = replace(source, jaw_file=jaw_file, parameters={**source.parameters, "depth": NO_DEPTH})
    one = FrameImages(name=recording.name, fps=STILL_RATE, camera=image.camera, count=1, read=lambda: [image.color])
    try:
        found, look = approach(replace(recording, images=one), here, jaws, pose)
    except FinforceError:
        return np.inf
    seen = min(np.isfinite(jaw.pixels).all(axis=1).mean() for jaw in look.jaws.values())
    return found.residual if seen >= ENOUGH else np.inf


def _other_poses(T: NDArray, own: str) -> Iterator[tuple[str, NDArray, str]]:
    """Yield other readings of the extrinsics: in words, the extrinsics by them, and the jaw file as it is."""
    body = _pose_of(Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]))
    poses = {
        "T_gripper_camera is inverted, the gripper in the camera's frame: give its inverse": invert_pose(T),
        "T_gripper_camera is of the camera's body (x ahead): give that of its optical frame (z ahead)": T @ body,
        "the camera is on the other side of the gripper: turn T_gripper_camera by half a turn about the gripper's z, "
        "left and right change places": HALF_TURN @ T,
        "the quaternion of T_gripper_camera begins with w: give x y z w": _reorder(T),
    }
    for words, pose in poses.items():
        yield words, pose, own


def _other_fingers(T: NDArray, own: str) -> Iterator[tuple[str, NDArray, str]]:
    """Yield the other included fingers: in words, the extrinsics as they are, and the jaw file."""
    for name in list_shipped_jaws():
        if name != own and load_jaw(name).model != "frame":
            yield f"the finger is {name}: give its jaw file", T, name


def _pose_of(rotation: Rotation) -> NDArray:
    T = np.eye(4)
    T[:3, :3] = rotation.as_matrix()
    return T


def _reorder(T: NDArray) -> NDArray:
    """Return a pose whose quaternion was read as x y z w, and meant as w x y z."""
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    turned = _pose_of(Rotation.from_quat([y, z, w, x]))
    turned[:3, 3] = T[:3, 3]
    return turned


GIVEN, SEEN, FITTED = (150, 150, 150), (60, 230, 90), (255, 170, 40)


def _draw(
    mean: RgbdImage, jaws: Mapping[str, Jaw], given: NDArray, found: Extrinsics | None, look: JawsAtRest | None
) -> NDArray:
    """Return the mean image with the jaws as given in grey, as fitted in orange, and the key points seen in green."""
    picture, camera = mean.color.copy(), mean.camera
    middle = 0.5 * (OpeningRange().nearest + OpeningRange().farthest)
    for side, jaw in jaws.items():
        sign, turn = -1.0 if side == "left" else 1.0, look.jaws[side].turn if look else None
        poses = [(given, sign * abs(found.origins[side]) if found else sign * middle, GIVEN)]
        if found is not None:
            poses.append((found.T_gripper_camera, found.origins[side], FITTED))
        for T, origin, color in poses:
            draw_jaw(picture, jaw, jaw_in_camera(T, side, origin, turn), camera, color)
    for jaw in look.jaws.values() if look else ():
        draw_points(picture, jaw.pixels, SEEN)
    return picture


def draw_jaw(picture: NDArray, jaw: Jaw, T_camera_jaw: NDArray, camera: CameraIntrinsics, color: Sequence[int]) -> None:
    """Draw the lines of a jaw's side into a picture (h, w, 3)."""
    cv2, plane = import_cv2(), find_side(jaw)
    for ring in find_shape(jaw).rings:
        line = project_plane(np.vstack((ring, ring[:1])), plane, T_camera_jaw, camera)
        for part in np.split(line, np.flatnonzero(~np.isfinite(line).all(axis=1))):
            part = part[np.isfinite(part).all(axis=1)]
            if len(part) > 1:
                shifted = np.round(8.0 * np.clip(part, -4e3, 4e3)).astype(np.int32)
                cv2.polylines(picture, [shifted], False, color, 1, cv2.LINE_AA, 3)


def draw_points(picture: NDArray, pixels: NDArray, color: Sequence[int]) -> None:
    """Draw circles around pixels (n, 2), those that are finite, into a picture (h, w, 3)."""
    for x, y in pixels[np.isfinite(pixels).all(axis=1)]:
        import_cv2().circle(picture, (round(8 * x), round(8 * y)), 24, color, 1, import_cv2().LINE_AA, 3)
