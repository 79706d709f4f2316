"""The detector that parameters ask for, from the network's files to the geometry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from finforce.skipping import Skips
    from finforce_ifea.jaw.jaw import Jaw
    from finforce_keypoints.detector import KeypointDetector
    from finforce_keypoints.detectors.dots import DotSettings
    from finforce_keypoints.detectors.side_plane import SideLocator
    from finforce_keypoints.networks.model import KeypointModel
    from finforce_keypoints.parameters import DetectorParameters
    from finforce_keypoints.pixel_finder import PixelFinder
    from finforce_keypoints.settings import DetectorSettings

MODELS = Path(__file__).parent / "models"
ANY_FINGER, BENCH = MODELS / "side_plane", MODELS / "plane"
ANSWERS = {"auto": None, "yes": True, "no": False}


@dataclass(frozen=True, kw_only=True)
class FinderCard:
    """What finds the key points, by name; the checksum of its network, empty without one."""

    name: str
    sha256: str = ""


class BuiltDetector(NamedTuple):
    """A detector, and what finds the key points for it."""

    detector: KeypointDetector
    card: FinderCard


class BuiltFinder(NamedTuple):
    """What finds the pixels of key points, and its card."""

    finder: PixelFinder
    card: FinderCard


def build_detector(
    jaws: Mapping[str, Jaw],
    parameters: DetectorParameters,
    settings: DetectorSettings | None = None,
    dots: DotSettings | None = None,
    skips: Skips | None = None,
) -> BuiltDetector:
    """Return the detector of the jaws (by side) that the parameters ask for; it leaves out nothing without `skips`.

    Raises:
        PoseError: the camera's pose is none.
        KeypointError: the network, its names or a setting cannot be used.
        MissingDependencyError: a library that the finder needs is not installed.
    """
    from finforce_keypoints.detector import KeypointDetector
    from finforce_keypoints.parameters import ALIGNED
    from finforce_keypoints.settings import DetectorSettings

    T_gripper_camera = parameters.camera_pose
    settings = settings or DetectorSettings()
    if parameters.depth != ALIGNED:
        settings = replace(settings, plane_depth=True)
    finder, card = build_finder(jaws, parameters, settings, dots)
    return BuiltDetector(KeypointDetector(finder, jaws, T_gripper_camera, settings, skips), card)


def build_finder(
    jaws: Mapping[str, Jaw], parameters: DetectorParameters, settings: DetectorSettings, dots: DotSettings | None = None
) -> BuiltFinder:
    """Return what finds the pixels of key points; see `build_detector`."""
    from finforce.gripper_frames import OpeningRange
    from finforce_keypoints.detectors.locators import AnyFinger, OneFinger
    from finforce_keypoints.detectors.side_plane import PlaneFinder
    from finforce_keypoints.networks.side_network import COARSE, SideNetwork

    opening = OpeningRange(nearest=settings.opening_min, farthest=settings.opening_max)
    if parameters.finder == "dots":
        from finforce_keypoints.detectors.dots import DotFinder

        return BuiltFinder(DotFinder(jaws, dots, parameters.camera_pose, opening), FinderCard(name="dots"))
    if parameters.finder == "frame":
        model = load_model(parameters)
        finder = _build_frame_finder(model, jaws, parameters)
        return BuiltFinder(finder, FinderCard(name=f"frame {model.path.stem}", sha256=model.sha256))
    folder = Path(parameters.model) if parameters.model else choose_network(jaws)
    if (folder / COARSE).is_file():
        network = SideNetwork(folder, threads=parameters.threads)
        locator: SideLocator = AnyFinger(network, jaws)
    else:
        network = load_model(replace(parameters, model=str(folder)))
        locator = OneFinger(network, jaws)
    finder = PlaneFinder(locator, jaws, parameters.camera_pose, opening)
    return BuiltFinder(finder, FinderCard(name=f"network {folder.name}", sha256=network.sha256))


def choose_network(jaws: Mapping[str, Jaw]) -> Path:
    """Return the folder of the shipped network for some jaws: the finger `bench` with its points has one of its own."""
    from finforce_ifea.jaw.jaw import load_jaw

    bench = load_jaw("bench")
    own = [(jaw.digest, jaw.keypoint_names) == (bench.digest, bench.keypoint_names) for jaw in jaws.values()]
    return BENCH if all(own) else ANY_FINGER


def load_model(parameters: DetectorParameters) -> KeypointModel:
    """Load the DeepLabCut network that the parameters name.

    Raises:
        ModelError: there is no name, its files are missing, or do not agree with the metadata and the parameters.
        MissingDependencyError: onnxruntime is not installed.
    """
    from finforce_keypoints.errors import ModelError
    from finforce_keypoints.networks.model import KeypointModel, ModelOverrides

    size = tuple(parameters.input_size)
    overrides = ModelOverrides(
        stride=parameters.stride or None,
        locref_std=parameters.locref_std or None,
        apply_sigmoid=ANSWERS[parameters.apply_sigmoid],
        normalize=ANSWERS[parameters.normalize],
        input_size=size if any(size) else None,
    )
    if parameters.finder == "frame" and not parameters.model:
        raise ModelError(
            "finder frame: got no model, and the shipped network sees rectified side planes; expected the folder of a "
            "DeepLabCut network as `model`, or finder network"
        )
    model = KeypointModel(parameters.model, overrides, threads=parameters.threads)
    if parameters.finder == "frame" and "plane" in model.metadata.extra:
        raise ModelError(
            f"finder frame: {model.path.parent} holds a network of rectified side planes (finforce: plane in its "
            "metadata); expected one that sees the image, or finder network"
        )
    return model


def _build_frame_finder(model: KeypointModel, jaws: Mapping[str, Jaw], parameters: DetectorParameters) -> PixelFinder:
    """Return the finder of a network that sees the image, under the names that the parameters give."""
    from finforce_keypoints.detectors.whole_image import FrameFinder
    from finforce_keypoints.networks.metadata import build_name_map, parse_mapping

    mapping = parse_mapping(entry for entry in parameters.names if entry)
    return FrameFinder(model, build_name_map(model.names, jaws, mapping), jaws, allow_resize=parameters.allow_resize)
