"""The detector that parameters ask for, from the network's files to the geometry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from finforce.gripper_frames import OpeningRange
from finforce_ifea.jaw.jaw import Jaw, load_jaw
from finforce_keypoints.detector import KeypointDetector
from finforce_keypoints.detectors.dots import DotDetector, DotSettings
from finforce_keypoints.detectors.side_plane import AnyFinger, OneFinger, SidePlaneDetector
from finforce_keypoints.detectors.whole_image import WholeImageDetector
from finforce_keypoints.errors import ModelError
from finforce_keypoints.images import ImageWatch, PixelDetector
from finforce_keypoints.networks.metadata import build_name_map, parse_mapping
from finforce_keypoints.networks.model import KeypointModel
from finforce_keypoints.networks.side_network import COARSE, SideNetwork
from finforce_keypoints.parameters import ALIGNED, DetectorParameters, DetectorSettings, JawMount, find_mounts
from finforce_keypoints.tags import TagFinder

MODELS = Path(__file__).parent / "models"
ANY_FINGER, BENCH = MODELS / "side_plane", MODELS / "plane"


def build_detector(
    jaws: Mapping[str, Jaw],
    parameters: DetectorParameters,
    settings: DetectorSettings | None = None,
    dots: DotSettings | None = None,
    rests: bool = False,
) -> KeypointDetector:
    """Return the detector of the jaws (by side) that the parameters ask for.

    Args:
        jaws: side -> jaw.
        parameters: of the node.
        settings: of the geometry.
        dots: appearance of dots, where they are used.
        rests: True if pixels and depth are left out where nothing has moved.

    Raises:
        PoseError: the camera's pose is none.
        KeypointError: the network, its names or a setting cannot be used.
        MissingDependencyError: a library that the method needs is not installed.
    """
    settings = settings or DetectorSettings()
    if parameters.depth != ALIGNED:
        settings = replace(settings, plane_depth=True)
    mounts = find_mounts(parameters, jaws)
    pixel_detector = build_pixel_detector(jaws, parameters, settings, dots, mounts)
    ids = [mount.tag.id for mount in mounts.values() if mount.tag is not None]
    return KeypointDetector(
        pixel_detector,
        jaws,
        parameters.camera_pose,
        settings,
        ImageWatch(),
        rests,
        mounts,
        TagFinder(parameters.tag_family, ids) if ids else None,
    )


def build_pixel_detector(
    jaws: Mapping[str, Jaw],
    parameters: DetectorParameters,
    settings: DetectorSettings,
    dots: DotSettings | None = None,
    mounts: Mapping[str, JawMount] | None = None,
) -> PixelDetector:
    """Return what finds the pixels of key points; see `build_detector`."""
    opening = OpeningRange(nearest=settings.opening_min, farthest=settings.opening_max)
    if parameters.detection_method == "dots":
        return DotDetector(jaws, dots, parameters.camera_pose, opening)
    if parameters.detection_method == "frame":
        return _build_whole_image_detector(jaws, parameters)

    folder = Path(parameters.model) if parameters.model else choose_network(jaws)
    mounts = mounts or find_mounts(parameters, jaws)
    if (folder / COARSE).is_file():
        locator: AnyFinger | OneFinger = AnyFinger(SideNetwork(folder, threads=parameters.threads), jaws, mounts)
    else:
        locator = OneFinger(KeypointModel(folder, threads=parameters.threads), jaws)
    return SidePlaneDetector(locator, jaws, parameters.camera_pose, opening, mounts)


def choose_network(jaws: Mapping[str, Jaw]) -> Path:
    """Return the folder of the shipped network for some jaws: the finger `bench` with its points has one of its own."""
    bench = load_jaw("bench")
    own = [(jaw.digest, jaw.keypoint_names) == (bench.digest, bench.keypoint_names) for jaw in jaws.values()]
    return BENCH if all(own) else ANY_FINGER


def _build_whole_image_detector(jaws: Mapping[str, Jaw], parameters: DetectorParameters) -> PixelDetector:
    """Return the detector of a DeepLabCut network that sees the image, under the names that the parameters give.

    Raises:
        ModelError: no network is named, or one of side planes.
    """
    if not parameters.model:
        raise ModelError(
            "detection_method frame: got no model, and the included network needs rectified side planes; expected the "
            "folder of a DeepLabCut network as `model`, or detection_method network"
        )
    model = KeypointModel(parameters.model, threads=parameters.threads)
    if model.metadata.finforce.plane is not None:
        raise ModelError(
            f"detection_method frame: {model.path.parent} holds a network of rectified side planes (finforce: plane in "
            "its metadata); expected one that sees the image, or detection_method network"
        )
    names = build_name_map(model.names, jaws, parse_mapping(entry for entry in parameters.names if entry))
    return WholeImageDetector(model, names, jaws, allow_resize=parameters.allow_resize)
