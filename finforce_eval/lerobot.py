"""The forces of the gripper as a step of LeRobot's observation processors, the same as `annotate` writes to datasets.

Works with LeRobot 0.4 and later, whose pipelines it takes part in as `finforce_forces`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.camera import ImageError
from finforce.gripper_frames import SIDES
from finforce.optional import import_library
from finforce_eval.errors import OptionError
from finforce_eval.policy import FEATURE, FORCE, PREFIX, STATE, STATE_FEATURE, ForceInput, PolicyForces
from finforce_eval.sensor import ForceSensor

_processor = import_library("lerobot.processor", "a processor step of LeRobot", "lerobot")
_types = import_library("lerobot.configs.types", "a processor step of LeRobot", "lerobot")

_IMAGES = "observation.images."
_WHITE = 255.0  # of a picture whose colours LeRobot has between 0 and 1


@_processor.ProcessorStepRegistry.register("finforce_forces")
@dataclass(kw_only=True)
class ForceProcessorStep(_processor.ObservationProcessorStep):
    """Adds the forces on the jaws to the observations of one robot.

    The observation of a robot gets a number under each of `names`. LeRobot puts those that the features of a dataset
    name into `observation.state`, or another feature, when it records and when it runs a policy. Where an observation
    has `observation.state` already, the numbers are appended to it, or are a feature of their own.

    A step has the state of an episode: call `reset` before each, with the jaws open and unloaded for 1.5 s.

    Attributes:
        camera: of the wrist, as the robot or the dataset names it.
        contact_height: of first touch above the clamped base [m].
        rig: file by `finforce camera`, in place of `jaw`, `intrinsics` and `extrinsics`.
        jaw: name of a shipped jaw, or jaw file.
        intrinsics: fx, fy, cx, cy [px] and perhaps k1, k2, p1, p2, k3, or a file of them.
        extrinsics: the camera in `gripper_base`, see `ForceSensor`.
        calibration: of the finger; None for the material of the jaw file.
        sides: jaws in the images.
        columns: numbers to add, of `force`, `stddev` and `grasp`; these two and `prefix` as given to `annotate`.
        prefix: of the names.
        into: "state" or "feature"; means nothing for the observations of a robot.
        fps: images per second, as the dataset has them.
        depth: name of the depth image, aligned to the colours; None without.
        detector: parameters of the detector, see `ForceSensor`.
        settings: of the estimator.

    Raises:
        FinforceError: one of these cannot be used.
    """

    camera: str = "wrist"
    contact_height: float | None = None
    rig: str | None = None
    jaw: str | None = None
    intrinsics: list[float] | str | None = None
    extrinsics: list[float] | str | None = None
    calibration: str | None = None
    sides: tuple[str, ...] = SIDES
    columns: tuple[str, ...] = (FORCE,)
    prefix: str = PREFIX
    into: str = STATE
    fps: float = 30.0
    depth: str | None = None
    detector: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.into not in (STATE, FEATURE):
            raise OptionError(f"into {self.into}: expected {STATE} or {FEATURE}")
        self.sides, self.columns = tuple(self.sides), tuple(self.columns)
        self.camera = self.camera.removeprefix(_IMAGES)
        sensor = ForceSensor(
            self.jaw,
            camera=self.intrinsics,
            extrinsics=self.extrinsics,
            rig=self.rig,
            contact_height=self.contact_height,
            calibration=self.calibration,
            sides=self.sides,
            detector={"threads": 1, "depth": "auto" if self.depth else "none", **self.detector},
            settings=self.settings,
            is_video=True,
        )
        sensor.warm_up()
        self._input = ForceInput(sensor, PolicyForces(self.sides, self.columns, self.prefix), self.fps)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers, in their order."""
        return self._input.names

    @property
    def status(self) -> str:
        """The reason why the last image has no grasp force, "ok" where it has one, "" before the first."""
        return self._input.last.status if self._input.last else ""

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return an observation with the forces in its images.

        Raises:
            ImageError: it has no image of the camera, one of no picture's shape, or several at once.
        """
        of_policy = f"{_IMAGES}{self.camera}" in observation
        head = _IMAGES if of_policy else ""
        depth = None if self.depth is None else _find(observation, f"{head}{self.depth.removeprefix(_IMAGES)}")
        row = self._input.update(
            to_picture(_find(observation, f"{head}{self.camera}"), self.camera),
            None if depth is None else _to_array(depth).squeeze(),
        )
        if not of_policy:
            return observation | dict(zip(self.names, row.tolist(), strict=True))
        name = STATE_FEATURE if self.into == STATE else f"observation.{self.prefix}"
        return observation | {name: _append(observation.get(STATE_FEATURE), row, keep=self.into == STATE)}

    def transform_features(self, features: Mapping[Any, Mapping[str, Any]]) -> dict[Any, dict[str, Any]]:
        """Return the features of a pipeline with those that the step adds, see `observation`."""
        kind = _types.PipelineFeatureType.OBSERVATION
        known = dict(features.get(kind, {}))
        if f"{_IMAGES}{self.camera}" in known or STATE_FEATURE in known:
            name = STATE_FEATURE if self.into == STATE else f"observation.{self.prefix}"
            before = known[STATE_FEATURE].shape[0] if self.into == STATE and STATE_FEATURE in known else 0
            known[name] = _types.PolicyFeature(type=_types.FeatureType.STATE, shape=(before + len(self.names),))
        else:
            known |= dict.fromkeys(self.names, float)
        return {**features, kind: known}

    def reset(self) -> None:
        """Forget the episode; the next images show the jaws unloaded."""
        self._input.reset()

    def get_config(self) -> dict[str, Any]:
        """Return what the step is made from, for the JSON of a pipeline."""
        return asdict(self)


def _find(observation: Mapping[str, Any], name: str) -> Any:
    """Return an image of an observation; raises ImageError where there is none."""
    if name not in observation:
        raise ImageError(f"no image {name}: expected one among {', '.join(observation) or 'nothing'}")
    return observation[name]


def _to_array(image: Any) -> NDArray:
    """Return an array, or a tensor of any device, as an array."""
    return np.asarray(image.detach().cpu() if hasattr(image, "detach") else image)


def to_picture(image: Any, name: str = "image") -> NDArray[np.uint8]:
    """Return an image in any of LeRobot's forms as (h, w, 3) uint8 RGB.

    Args:
        image: array or tensor, (h, w, 3) or (3, h, w), perhaps as a batch of one; uint8, or floats from 0 to 1.
        name: for messages.

    Raises:
        ImageError: it has another form.
    """
    picture = _to_array(image)
    if picture.ndim == 4 and len(picture) == 1:
        picture = picture[0]
    if picture.ndim == 3 and picture.shape[0] == 3 and picture.shape[2] != 3:
        picture = picture.transpose(1, 2, 0)
    if picture.ndim != 3 or picture.shape[2] != 3:
        raise ImageError(f"{name} of shape {picture.shape}: expected one picture, (h, w, 3) or (3, h, w)")
    if picture.dtype.kind == "f":
        if not (np.isfinite(picture).all() and picture.min() >= 0.0 and picture.max() <= 1.0):
            raise ImageError(f"{name} from {picture.min():g} to {picture.max():g}: expected 0 to 1, not normalised")
        picture = np.round(_WHITE * picture).astype(np.uint8)
    if picture.dtype != np.uint8:
        raise ImageError(f"{name} of {picture.dtype}: expected uint8, or floats from 0 to 1")
    return np.ascontiguousarray(picture)


def _append(state: Any, row: NDArray[np.float32], *, keep: bool) -> Any:
    """Return numbers (n,) behind a state (m,) or (1, m), or alone, in its form; without a state, an array."""
    if state is None:
        return row
    if state.ndim > 1 and len(state) != 1:
        raise ImageError(f"a state of shape {tuple(state.shape)}: expected one robot at a time")
    shape = (*state.shape[:-1], -1)
    if isinstance(state, np.ndarray):
        own = row.astype(state.dtype).reshape(shape)
        return np.concatenate([state, own], axis=-1) if keep else own
    own = state.new_tensor(row.tolist()).reshape(shape)
    return import_library("torch", "a state of LeRobot").cat([state, own], dim=-1) if keep else own
