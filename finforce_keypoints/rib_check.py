"""The check that ribs in pictures of open jaws are where a rig has them, and match no other position as well."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finforce.camera import CameraIntrinsics
from finforce.gripper_frames import OpeningRange, jaw_in_camera
from finforce_keypoints.geometry.rib_pattern import SLANTS, STRETCHES, RibPattern, RibScan
from finforce_keypoints.parameters import JawMount

if TYPE_CHECKING:
    from finforce_ifea.jaw.jaw import Jaw

OPENING_STEP = 1.5e-3  # [m] between the openings at which jaws are looked for
PLACES, PLACES_HERE = 8, 4  # of a finger that are compared, and more of them within half a rib
APART = 0.35  # [pitches] between two of them, root mean square of the ribs to be seen
HERE = 0.5  # [pitches] within which a place is the one that a rig has
SAME = 0.6  # [pitches] from the best place here within which another is its flank, unless it is clearly likelier
# Evidence, see `RibPlace`, by which a place has to be likelier than others, and least correlation of a jaw that tells.
LEAST_MARGIN, LEAST_RIBS = 0.1, 0.25
LEAST_EVIDENCE = 0.7  # of the jaws in the mean, if they show at all: 1.0 to 2.6 of those that are right
# [rad] standard deviation of a jaw's turn in its plane: two ribs moved apart turn jaws and camera. Independent pixels
# that the evidence is of.
MOUNT_STDDEV, INDEPENDENT = 0.03, 10.0


@dataclass(frozen=True, kw_only=True, eq=False)
class RibPlace:
    """A place of a finger on its own side, in all pictures of a rig.

    Attributes:
        evidence: minus the logarithms of what ribs and tip leave unexplained of the pictures, in the mean.
        ribs: correlation of ribs and cells with the pictures, in the mean.
        shift: mean shift of the ribs towards the tip from where the rig has them [m].
        distance: root mean square of that, in pitches.
        warps: affine maps (n, 2, 3) of x and z [m] from where the rig has the finger to there, in each picture.
    """

    evidence: float
    ribs: float
    shift: float
    distance: float
    warps: NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class RibComparison:
    """Possible places of the ribs of a jaw.

    Attributes:
        here: the best place within half a rib of the rig's.
        other: the best of all others that a camera and mounts can realise together with a place of the other jaw.
        mate: evidence that the other jaw loses by that.
    """

    here: RibPlace
    other: RibPlace
    mate: float = 0.0

    @property
    def margin(self) -> float:
        """Evidence for the rig's place over that for any other."""
        return self.here.evidence - self.other.evidence + self.mate

    def describe(self, side: str) -> str:
        """Return in words what speaks against the rig's place; empty if nothing does."""
        shift = f"{1e3 * abs(self.other.shift):.1f} mm towards the {'tip' if self.other.shift > 0.0 else 'base'}"
        fits = f"(ribs {self.other.ribs:.2f}, here {self.here.ribs:.2f}; evidence {self.margin:+.2f})"
        if self.margin < 0.0:
            return f"{side} jaw: the ribs are rather {shift} {fits}"
        if self.margin < LEAST_MARGIN:
            return f"two places explain the pictures alike: {side} jaw here, and {shift} {fits}"
        return ""


def compare_ribs(
    patterns: Mapping[str, RibPattern],
    images: Sequence[NDArray],
    poses: Mapping[str, Sequence[NDArray]],
    camera: CameraIntrinsics,
) -> dict[str, RibComparison]:
    """Return by side where the ribs of jaws may be in pictures of one rig.

    Args:
        patterns: of the jaws' sides.
        images: (h, w, 3) uint8 RGB, of open and unloaded jaws.
        poses: side -> T_camera_jaw (4, 4) in each.
        camera: intrinsics.
    """
    nothing = RibPlace(evidence=0.0, ribs=0.0, shift=0.0, distance=0.0, warps=np.zeros((0, 2, 3)))
    found = find_places(patterns, images, poses, camera)
    here, rivals = {}, {}
    for side, places in found.items():
        near = [each for each in places if each.distance < HERE]
        best = here[side] = max(near, key=lambda each: each.evidence, default=nothing)
        rivals[side] = [
            each
            for each in places
            if each.distance >= HERE
            and (
                abs(each.shift - best.shift) > SAME * patterns[side].pitch
                or each.evidence > best.evidence + LEAST_MARGIN
            )
        ]
    apart = np.linalg.norm(np.subtract(*[each[0][:3, 3] for each in poses.values()])) if len(poses) > 1 else np.inf
    compared = {}
    for side in found:
        mate = next((other for other in found if other != side), None)

        def lose(place: RibPlace, mate: str | None = mate) -> float:
            """Return what evidence the other jaw loses if this one is at a place."""
            if mate is None:
                return 0.0
            turns = {each: (each.shift - place.shift) / (apart * MOUNT_STDDEV) for each in [here[mate], *rivals[mate]]}
            return here[mate].evidence - max(each.evidence - turns[each] ** 2 / INDEPENDENT for each in turns)

        other = max(rivals[side], key=lambda each, lose=lose: each.evidence - lose(each), default=nothing)
        compared[side] = RibComparison(here=here[side], other=other, mate=lose(other) if rivals[side] else 0.0)
    return compared


def compare_rig(
    jaws: Mapping[str, Jaw],
    images: Sequence[NDArray],
    camera: CameraIntrinsics,
    T_gripper_camera: NDArray,
    mounts: Mapping[str, JawMount],
    opening: OpeningRange,
) -> dict[str, RibComparison]:
    """Return by side where the ribs may be in pictures of a known rig, whose jaws are as far open as tips show best.

    Args:
        jaws: by side.
        images: (h, w, 3) uint8 RGB, of open and unloaded jaws.
        camera: intrinsics.
        T_gripper_camera: (4, 4).
        mounts: mounting of the jaws, by side.
        opening: where the jaws can be.
    """
    patterns, poses = {side: RibPattern(jaw) for side, jaw in jaws.items()}, {}
    for side, pattern in patterns.items():
        sign = -1.0 if side == "left" else 1.0
        halves = sign * np.arange(opening.nearest, opening.farthest, OPENING_STEP)
        tried = [jaw_in_camera(T_gripper_camera, side, x, mounts[side].turn) for x in halves]
        rest = pattern.warp(0.0, 0.0, 0.0, 0.0)
        poses[side] = [
            max(tried, key=lambda T, color=color, pattern=pattern: pattern.contrast(color, T, camera, rest))
            for color in images
        ]
    return compare_ribs(patterns, images, poses, camera)


def describe_ribs(compared: dict[str, RibComparison]) -> list[str]:
    """Return in words what speaks against the places of jaws, by side; empty if nothing does."""
    if np.mean([max(each.here.evidence, each.other.evidence) for each in compared.values()]) < LEAST_EVIDENCE:
        return ["neither ribs nor tips show where the jaws should be"]
    said = [words for side, each in compared.items() if (words := each.describe(side))]
    here = max(each.here.ribs for each in compared.values())
    if not said and here < LEAST_RIBS:
        return [f"no ribs show where the jaws are (correlation {here:.2f}, expected {LEAST_RIBS:g})"]
    return said


def find_places(
    patterns: Mapping[str, RibPattern],
    images: Sequence[NDArray],
    poses: Mapping[str, Sequence[NDArray]],
    camera: CameraIntrinsics,
) -> dict[str, list[RibPlace]]:
    """Return by side the likeliest places of jaws beside given ones, some of them within half a rib.

    Ribs may be brighter than cells or darker, but alike on all jaws in all pictures: half a rib further they are not.
    The arguments are those of `compare_ribs`.
    """
    scans = {
        side: [pattern.scan(color, T, camera) for color, T in zip(images, poses[side], strict=True)]
        for side, pattern in patterns.items()
    }
    found = [
        {
            side: _find_places(
                pattern, [replace(each, ribs=sign * each.ribs) for each in scans[side]], images, poses[side], camera
            )
            for side, pattern in patterns.items()
        }
        for sign in (1.0, -1.0)
    ]
    return max(found, key=lambda places: sum(max((p.evidence for p in each), default=0.0) for each in places.values()))


def _find_places(
    pattern: RibPattern,
    scans: Sequence[RibScan],
    images: Sequence[NDArray],
    poses: Sequence[NDArray],
    camera: CameraIntrinsics,
) -> list[RibPlace]:
    """Return the likeliest places of a jaw whose ribs are brighter than its cells."""
    shifts = scans[0].along[None, :, None] + STRETCHES[:, None, None] * pattern.heights
    evidence = np.mean([-np.log1p(-(np.maximum(scan.ribs, 0.0).max(axis=3) ** 2)) for scan in scans], axis=0)
    is_here = np.sqrt((shifts**2).mean(axis=2)) < HERE * pattern.pitch
    found: list[RibPlace] = []
    for is_wanted, count in ((np.ones_like(is_here), PLACES), (is_here, PLACES_HERE)):
        left = np.where(is_wanted[:, None, :], evidence, 0.0)
        for _ in range(count):
            place = np.unravel_index(int(np.argmax(left)), left.shape)
            if left[place] <= 0.0:
                break
            moved = shifts[place[0], place[2]]
            fits = [_fit(pattern, *each, place, camera) for each in zip(scans, images, poses, strict=True)]
            found.append(
                RibPlace(
                    evidence=float(np.mean([_sum_evidence(fit.ribs, fit.tip) for fit in fits])),
                    ribs=float(np.mean([fit.ribs for fit in fits])),
                    shift=float(moved.mean()),
                    distance=float(np.sqrt((moved**2).mean()) / pattern.pitch),
                    warps=np.array([fit.warp for fit in fits]),
                )
            )
            near = np.sqrt(((shifts - moved) ** 2).mean(axis=2)) < APART * pattern.pitch
            left = np.where(near[:, None, :], 0.0, left)
    return found


class _Fit(NamedTuple):
    """The match of a picture with a position: its warp (2, 3), the correlation of the ribs, the contrast of the tip."""

    warp: NDArray
    ribs: float
    tip: float


def _sum_evidence(ribs: float, tip: float) -> float:
    return -float(np.log1p(-(ribs**2)) + np.log1p(-min(tip, 0.99)))


def _fit(
    pattern: RibPattern, scan: RibScan, color: NDArray, T: NDArray, place: Sequence[int], camera: CameraIntrinsics
) -> _Fit:
    """Return the fit of a place, across the finger and within a pixel along it where ribs and tip together fit best."""
    i, k, centre = place
    best = _Fit(pattern.warp(STRETCHES[i], SLANTS[k], 0.0, scan.along[centre]), 0.0, 0.0)
    rows = range(max(centre - 1, 0), min(centre + 2, len(scan.along)))
    for n, m in product(rows, range(len(scan.across))):
        ribs = float(scan.ribs[i, k, n, m])
        if ribs > 0.0:
            warp = pattern.warp(STRETCHES[i], SLANTS[k], scan.across[m], scan.along[n])
            fit = _Fit(warp, ribs, pattern.contrast(color, T, camera, warp))
            best = max(best, fit, key=lambda each: _sum_evidence(each.ribs, each.tip))
    return best
