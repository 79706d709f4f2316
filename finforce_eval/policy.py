"""Forces as policies take them: a row of finite numbers per image, with flags that say which of them are known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from finforce.camera import ImageError
from finforce.errors import ObservationError
from finforce.gripper_frames import SIDES
from finforce.messages import NANOSECONDS
from finforce_eval.errors import OptionError
from finforce_eval.sensor import ForceSensor, GripperForces
from finforce_eval.table import AXES, ForceSeries
from finforce_keypoints.errors import KeypointError

INTO = NONE, FEATURE, STATE = ("none", "feature", "state")
COLUMNS = FORCE, STDDEV, GRASP = ("force", "stddev", "grasp")
PREFIX = "force"
STATE_FEATURE = "observation.state"
_TAKEN_BY_POLICIES = ("observation", "action")  # prefixes of the features that LeRobot hands to policies


class PolicyForces:
    """Turns the forces in one image after the other into rows of numbers.

    Each jaw is a group of numbers, and so is the grasp force; behind each group stands its flag `valid`, 1 where the
    image has an answer. Elsewhere the group repeats its last answer in the episode, or zeros before the first.

    Attributes:
        names: of the numbers in a row.
        groups: by their names, the number of each group's flag, behind its own numbers.

    Args:
        sides: jaws.
        columns: numbers to include, of `COLUMNS`.
        prefix: of the names.

    Raises:
        OptionError: a column is unknown, or the prefix is one of LeRobot's.
    """

    def __init__(self, sides: Sequence[str] = SIDES, columns: Sequence[str] = (FORCE,), prefix: str = PREFIX) -> None:
        check_prefix(prefix)
        if not columns or not set(columns) <= set(COLUMNS):
            raise OptionError(f"columns {', '.join(columns) or 'none'}: expected some of {', '.join(COLUMNS)}")
        infixes = [infix for column, infix in ((FORCE, ""), (STDDEV, "stddev.")) if column in columns]
        self._columns = columns
        groups = {side: [f"{prefix}.{side}.{infix}{axis}" for infix in infixes for axis in AXES] for side in sides}
        grasp = [f"{prefix}.{GRASP}", *([f"{prefix}.{GRASP}.{STDDEV}"] if STDDEV in columns else [])]
        groups |= {GRASP: grasp if GRASP in columns else []}
        groups = {group: names for group, names in groups.items() if names}
        self.names = tuple(n for group, names in groups.items() for n in (*names, f"{prefix}.{group}.valid"))
        self._sizes = {group: len(names) for group, names in groups.items()}
        ends = np.cumsum([size + 1 for size in self._sizes.values()]) - 1
        self.groups = {f"{prefix}.{group}": end for group, end in zip(groups, ends.tolist(), strict=True)}
        self.reset()

    def reset(self) -> None:
        """Forget the last answers; for a new episode."""
        self._last = {group: np.zeros(size) for group, size in self._sizes.items()}

    def update(
        self, force: Mapping[str, NDArray], stddev: Mapping[str, NDArray], grasp: Sequence[float]
    ) -> NDArray[np.float32]:
        """Return the row (n,) of an image.

        Args:
            force: side -> force (3,) [N]; NaN, or no entry, without an answer.
            stddev: side -> one standard deviation (3,) [N].
            grasp: grasp force and its standard deviation [N], or NaN.
        """
        row = []
        for group, size in self._sizes.items():
            values = np.asarray(grasp)[:size] if group == GRASP else self._vectors(group, force, stddev)
            valid = bool(np.isfinite(values).all())
            if valid:
                self._last[group] = values
            row += [*self._last[group], float(valid)]
        return np.array(row, dtype=np.float32)

    def _vectors(self, side: str, force: Mapping[str, NDArray], stddev: Mapping[str, NDArray]) -> NDArray:
        """Return the numbers of a jaw that are included; NaN without an answer."""
        if side not in force or not np.isfinite(force[side]).all():
            return np.full(self._sizes[side], np.nan)
        chosen = [given[side] for column, given in ((FORCE, force), (STDDEV, stddev)) if column in self._columns]
        return np.concatenate(chosen)

    def rows_of(self, series: Mapping[str, ForceSeries], grasp: NDArray) -> NDArray[np.float32]:
        """Return the rows (m, n) of an episode's images.

        Args:
            series: forces by side.
            grasp: grasp forces and their standard deviations (m, 2) [N].
        """
        self.reset()
        force = {side: each.force for side, each in series.items()}
        stddev = {side: each.column("force_stddev") for side, each in series.items()}
        rows = [self.update(_at(index, force), _at(index, stddev), pair) for index, pair in enumerate(grasp)]
        return np.array(rows, dtype=np.float32).reshape(len(grasp), len(self.names))


def grasp_columns(gripper: ForceSeries) -> NDArray[np.float64]:
    """Return the grasp forces and their standard deviations (n, 2) [N] of a series by `combine_jaws`."""
    return np.stack([gripper.column(name).astype(float) for name in ("grasp_force", "grasp_stddev")], axis=1)


def _at(index: int, columns: Mapping[str, NDArray]) -> dict[str, NDArray]:
    return {side: values[index] for side, values in columns.items()}


def check_prefix(prefix: str) -> None:
    """Refuse names that LeRobot would hand to policies, or cannot store.

    Raises:
        OptionError: such a prefix.
    """
    if not prefix or "/" in prefix or prefix.startswith(_TAKEN_BY_POLICIES):
        raise OptionError(
            f"--prefix {prefix}: expected one that begins neither with observation nor with action, whose features "
            "LeRobot hands to policies, and has no slash, as force"
        )


class ForceInput:
    """Finds the forces in the images of an episode as they come, and returns them as rows for a policy.

    Args:
        sensor: of the gripper.
        forces: groups of columns of a row.
        fps: images per second, as the dataset has them.
    """

    def __init__(self, sensor: ForceSensor, forces: PolicyForces, fps: float) -> None:
        if not 0.0 < fps < 1e4:
            raise OptionError(f"fps {fps}: expected images per second, as 30")
        self._sensor, self._forces, self._fps = sensor, forces, fps
        self.names = forces.names
        self.reset()

    def reset(self) -> None:
        """Forget everything of the episode: its tare, its forces and its time."""
        self._sensor.reset()
        self._forces.reset()
        self._count = 0
        self.last: GripperForces | None = None

    def update(self, rgb: NDArray[np.uint8], depth: NDArray | None = None) -> NDArray[np.float32]:
        """Return the row (n,) of the next image; one that cannot be used has no answer.

        Args:
            rgb: (h, w, 3).
            depth: (h, w), see `ForceSensor.update`.
        """
        stamp = round(self._count * (NANOSECONDS / self._fps)) / NANOSECONDS
        self._count += 1
        try:
            self.last = self._sensor.update(rgb, depth, stamp)
        except (ImageError, KeypointError, ObservationError) as error:
            self.last = self._sensor.skip(stamp, str(error))
        told = {side: jaw for side, jaw in self.last.jaws.items() if jaw.trusted}
        force = {side: jaw.force for side, jaw in told.items()}
        stddev = {side: jaw.force_stddev for side, jaw in told.items()}
        return self._forces.update(force, stddev, (self.last.grasp, self.last.grasp_stddev))
