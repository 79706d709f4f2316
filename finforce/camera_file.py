"""Intrinsics from the files that people keep them in: ROS, OpenCV, kalibr, BOP, OpenICC, ORB-SLAM, COLMAP, numbers."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from finforce.camera import EQUIDISTANT, PLUMB_BOB, RATIONAL, CameraIntrinsics, IntrinsicsError, name_lens, name_matrix
from finforce.files import LARGEST_YAML, FileError, parse_json, parse_yaml, read_text

INTRINSICS_FORMS = (
    "fx fy cx cy [k1 k2 p1 p2 k3], or a file of ROS, OpenCV, kalibr, BOP, OpenICC, ORB-SLAM or COLMAP, of a 3x3 "
    "matrix, or with the names fx, fy, cx, cy"
)
_NAMES = ("fx", "fy", "cx", "cy")
_MATRICES = ("K", "k", "camera_matrix", "Camera_Matrix", "cameraMatrix", "cam_K", "intrinsic_matrix")
_LENS = re.compile(r"d|coeffs|dist(?!ance).*|(?!undist).*distortion.*", re.IGNORECASE)
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_COLMAP = {  # parameters of its models; f is fx and fy
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
}
_SIZES = {"width": ("width", "image_width", "image_Width"), "height": ("height", "image_height", "image_Height")}


def read_camera(path: str | Path, shape: tuple[int, int] | None = None, name: str = "") -> CameraIntrinsics:
    """Return the camera that a file describes.

    Args:
        path: YAML of ROS, OpenCV or kalibr, XML of OpenCV, JSON of BOP (camera, scene_camera) or OpenICC (as UMI uses
            it), COLMAP's cameras.txt, a text of fx fy cx cy or of a 3x3 matrix, or YAML or JSON with these names.
        shape: height and width of its images; without it the file has to say.
        name: of the camera (kalibr) or image (BOP), where a file has several that differ.

    Raises:
        IntrinsicsError: the file cannot be read, or describes no camera, several, one with images of another size, or
            one with a lens that is not known.
    """
    path = Path(path)
    try:
        content = parse_numbers(read_text(path))
        named = camera_numbers(content) if isinstance(content, list) else _name_entries(_choose(content, name))
        return build_camera(named, shape)
    except (FileError, IntrinsicsError) as error:
        raise IntrinsicsError(f"{path.name}: {error}") from error


def camera_numbers(numbers: Sequence[float]) -> dict[str, Any]:
    """Return fx fy cx cy and perhaps four or five coefficients of the lens, or a 3x3 matrix, by name."""
    if len(numbers) == 9 and list(numbers[6:]) == [0.0, 0.0, 1.0]:
        return name_matrix(numbers)
    if len(numbers) not in (4, 8, 9):
        raise IntrinsicsError(f"{len(numbers)} numbers; expected {INTRINSICS_FORMS}")
    return {**dict(zip(_NAMES, numbers, strict=False)), "distortion": list(numbers[4:])}


def build_camera(named: Mapping[str, Any], shape: tuple[int, int] | None) -> CameraIntrinsics:
    """Return the camera of entries by name: fx, fy, cx, cy, and perhaps width, height, distortion and model.

    Raises:
        IntrinsicsError: one is missing or no number, or they are of images of another size than `shape` (h, w).
    """
    try:
        values = {entry: float(named[entry]) for entry in _NAMES}
        distortion = np.array(named.get("distortion") or [], dtype=float)
        own = {entry: int(named[entry]) for entry in ("height", "width") if named.get(entry)}
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise IntrinsicsError(f"{error} is missing or no number; expected {INTRINSICS_FORMS}") from None
    size = dict(zip(("height", "width"), shape, strict=True)) if shape else own
    if (
        own | size != size | own
        or len(size) < 2
        or not all(isinstance(side, int) and side > 0 for side in own.values())
    ):
        found = " x ".join(str(own[entry]) for entry in ("width", "height") if entry in own) or "no size"
        expected = f"{shape[1]} x {shape[0]}, as the images have" if shape else "width and height next to the numbers"
        raise IntrinsicsError(f"intrinsics of {found}; expected {expected}")
    if not (0.0 <= values["cx"] <= size["width"] and 0.0 <= values["cy"] <= size["height"]):
        raise IntrinsicsError(
            f"principal point {values['cx']:g}, {values['cy']:g} outside images of {size['width']} x {size['height']}: "
            "are these the intrinsics of images of another size?"
        )
    model = str(named.get("model") or (RATIONAL if distortion.size > 5 else PLUMB_BOB))
    return CameraIntrinsics(**size, **values, distortion=distortion, model=name_lens(model))


def cut_camera(camera: CameraIntrinsics, shape: tuple[int, int], scale: float | None = None) -> CameraIntrinsics:
    """Return the camera of the middle of its images, scaled until they are h x w pixels (`shape`), or by `scale`."""
    height, width = shape
    scale = scale or max(height / camera.height, width / camera.width)
    middle = 0.5 * np.array([width / scale - camera.width, height / scale - camera.height])
    cx, cy = (np.array([camera.cx, camera.cy]) + middle + 0.5) * scale - 0.5
    lens = {"fx": camera.fx * scale, "fy": camera.fy * scale, "cx": float(cx), "cy": float(cy)}
    return replace(camera, width=width, height=height, **lens)


def parse_numbers(text: str) -> Any:
    """Return the content of a JSON or YAML text, that of OpenCV included, or a list where there are numbers alone."""
    try:
        return [float(part) for part in re.split(r"[\s,;]+", text.strip("[]() \t\r\n"))]
    except ValueError:
        pass
    if text.lstrip().startswith("{"):
        return parse_json(text)
    if colmap := re.findall(r"^\d+ ([A-Z_]+) (\d+ \d+ [^#\n]+)$", text, flags=re.MULTILINE):
        return _from_colmap(colmap)
    if text.lstrip().startswith("<"):
        return _parse_xml(text)
    if len(text) > LARGEST_YAML:
        raise FileError(f"has more than {LARGEST_YAML >> 10} KiB")
    text = re.sub(r"^%YAML.*", "", text, count=1).replace("!!opencv-matrix", "")
    parts = [part for part in re.split(r"^---\s*$", text, flags=re.MULTILINE) if part.strip()]  # messages, as echoed
    first, *others = [parse_yaml(part, text_keys=False) for part in parts] or [None]
    if any(_leave_out_header(each) != _leave_out_header(first) for each in others):
        raise IntrinsicsError("describes several cameras, one after the other; expected one")
    return first


def _leave_out_header(content: Any) -> Any:
    """Return a message without its header, whose stamp is another one in each."""
    return {key: value for key, value in content.items() if key != "header"} if isinstance(content, dict) else content


def _from_colmap(lines: Sequence[tuple[str, str]]) -> dict[str, Any]:
    """Return the entries of the one camera of COLMAP's lines: model, and size and parameters."""
    (model, words), *others = lines
    names = f"width height {_COLMAP.get(model, '')}".split()
    if any(each != lines[0] for each in others):
        raise IntrinsicsError(f"describes {len(lines)} cameras; expected one")
    try:
        named: dict[str, Any] = dict(zip(names, map(float, words.split()), strict=True))
        named |= {"cx": named["cx"] - 0.5, "cy": named["cy"] - 0.5}  # the middle of its first pixel is 0.5, 0.5
    except (KeyError, ValueError):
        raise IntrinsicsError(f"camera model {model[:40]} with {words[:99]}: expected {' or '.join(_COLMAP)}") from None
    focal = named.get("f")
    named |= {"fx": focal, "fy": focal} if focal else {}
    return named | ({"model": EQUIDISTANT} if "FISHEYE" in model else {})


def _parse_xml(text: str) -> dict[str, Any]:
    """Return the matrices, as lists, and the other entries of an XML text as OpenCV writes it."""
    named: dict[str, Any] = {}
    try:
        if "<!" in text:  # entities can be as large as one likes
            raise ElementTree.ParseError("declarations; expected none")
        for node in ElementTree.fromstring(text):
            words = (node.findtext("data") or node.text or "").split()
            try:
                numbers = list(map(float, words))
            except ValueError:
                named[node.tag] = " ".join(words)
            else:
                named[node.tag] = numbers[0] if len(numbers) == 1 else numbers
    except ElementTree.ParseError as error:
        raise FileError(f"is no XML of OpenCV: {error}") from error
    return named


def _choose(content: Any, name: str) -> Mapping[str, Any]:
    """Return the entries of one camera of a file, of which kalibr's and BOP's may have several."""
    if not isinstance(content, Mapping):
        raise IntrinsicsError(f"expected {INTRINSICS_FORMS}")
    cameras = {
        str(key): value
        for key, value in content.items()
        if isinstance(value, Mapping) and ("cam_K" in value or isinstance(value.get("intrinsics"), list))
    }
    if not cameras:
        return {re.sub(r"^Camera1?\.", "", str(key)): value for key, value in content.items()}  # of ORB-SLAM
    found = [cameras[name]] if name in cameras else [] if name else list(cameras.values())
    named = [_name_entries(each) for each in found]
    if not found or any(each != named[0] for each in named):
        what = f"no camera {name}, but" if name else "several cameras:"
        raise IntrinsicsError(f"{what} {', '.join([*cameras][:5])}; expected one of these behind the file's name")
    return found[0]


def _name_entries(entries: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a file says of a camera by the names of `build_camera`."""
    named: dict[str, Any] = {name: entries[name] for name in _NAMES if name in entries}
    for name, others in _SIZES.items():
        named[name] = next((entries[other] for other in others if entries.get(other) is not None), None)
    size = _numbers(entries.get("resolution") or entries.get("image_size"))
    if len(size) == 2:
        named |= {"width": size[0], "height": size[1]}
    matrix = next((each for each in (_numbers(entries.get(name)) for name in _MATRICES) if len(each) == 9), None)
    intrinsics, kind = entries.get("intrinsics"), str(entries.get("camera_model") or "pinhole")
    lens = None if kind == "pinhole" else kind  # fisheye, as ROS's camera_calibration writes it
    if matrix:
        named |= name_matrix(matrix)
    elif isinstance(intrinsics, Mapping):
        return named | _from_openicc(intrinsics, str(entries.get("intrinsic_type")))
    elif intrinsics is not None:
        kind, _, lens = kind.partition("-")  # pinhole, or pinhole-equi
        if kind != "pinhole" or len(_numbers(intrinsics)) != 4:
            raise IntrinsicsError(f"camera_model {entries.get('camera_model')}: expected pinhole, with fu fv pu pv")
        named |= zip(_NAMES, intrinsics, strict=True)
    # else that of the device, or what the coefficients say
    if EQUIDISTANT in [name_lens(str(entries.get(name))) for name in ("model", "type")]:
        lens = EQUIDISTANT
    lens = entries.get("distortion_model") or lens
    named["model"] = EQUIDISTANT if entries.get("fisheye_model") else lens
    named["distortion"] = _find_lens(entries, name_lens(str(named["model"])) == EQUIDISTANT)
    return named


def _find_lens(entries: Mapping[str, Any], is_fisheye: bool) -> list[Any]:
    """Return the coefficients of the lens: of a list, or k1, k2, ... by name, here or in an entry; none without any."""
    found = [value for name, value in entries.items() if _LENS.fullmatch(name)]
    if listed := next(filter(None, map(_numbers, found)), []):
        return listed
    named = next((each for each in (*found, entries) if isinstance(each, Mapping) and "k1" in each), {})
    if is_fisheye:
        return [named.get(name, 0.0) for name in ("k1", "k2", "k3", "k4")] if named else []
    if named.get("k4") and "p1" not in named:
        raise IntrinsicsError("k4 without p1: of a fisheye? expected model: equidistant next to them, or p1 and p2")
    count = 8 if any(named.get(name) for name in ("k4", "k5", "k6")) else 5
    return [named.get(name, 0.0) for name in _COEFFICIENTS[:count]] if named else []


def _from_openicc(intrinsics: Mapping[str, Any], kind: str) -> dict[str, Any]:
    """Return the entries of a camera of OpenICC, whose fisheye is the equidistant one.

    Source: Theia, FisheyeCameraModel.
    """
    if kind != "FISHEYE" or intrinsics.get("skew"):
        raise IntrinsicsError(f"intrinsic_type {kind}, skew {intrinsics.get('skew')}: expected FISHEYE without skew")
    try:
        focal = float(intrinsics["focal_length"])
        named = {"fx": focal, "fy": focal * float(intrinsics.get("aspect_ratio", 1.0))}
        bent = [intrinsics[f"radial_distortion_{number}"] for number in (1, 2, 3, 4)]
    except (KeyError, TypeError, ValueError) as error:
        raise IntrinsicsError(f"intrinsics: {error} is missing or no number") from None
    named |= {"cx": intrinsics.get("principal_pt_x"), "cy": intrinsics.get("principal_pt_y")}
    return named | {"distortion": bent, "model": EQUIDISTANT}


def _numbers(value: Any) -> list[Any]:
    """Return the entries of a list, of rows, or of what OpenCV and ROS write as `data`; none of anything else."""
    value = value.get("data") if isinstance(value, Mapping) else value
    rows = value if isinstance(value, list) else []
    return [number for row in rows for number in (row if isinstance(row, list) else [row])]
