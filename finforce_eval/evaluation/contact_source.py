"""Sources of the contact of an image: given once, or estimated from mesh, pose and deformed jaw."""

from __future__ import annotations

import math
import sys
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from finforce.camera import ImageError
from finforce.errors import PoseError
from finforce.health import Idling
from finforce.messages import SECOND
from finforce_contact.loop import ContactLoop, ContactSource, GivenContact, Surface
from finforce_contact.parameters import ContactParameters
from finforce_eval.errors import OptionError, RecordingError
from finforce_eval.evaluation.scoring import ONSET_FORCE
from finforce_eval.recordings.objects import (
    ObjectTrack,
    find_mesh,
    has_object,
    mean_pose,
    pose_object_in_images,
    require_mesh,
    track_object,
)
from finforce_eval.recordings.tracks import Recording
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.observation import Contact

ROUNDING = 500  # [ns] to which a stamp in seconds since 1970 is known


class RecordedContact(ContactLoop):
    """The contact estimator's loop, given the poses of a recording as they come.

    Args:
        estimator: a fresh ContactEstimator.
        track: the object's poses in the jaw frame.
        name: for reports.
        idling: passes images over as the contact estimator's node does; None for none.
        check: compares the mesh with the images of the recording; None where there are none.
        delay: from a pose's stamp to its arrival [ns].
    """

    def __init__(
        self,
        estimator: Any,
        track: ObjectTrack,
        name: str = "estimate",
        idling: Idling | None = None,
        check: RecordedCheck | None = None,
        delay: int = 0,
    ) -> None:
        super().__init__(estimator)
        self._check, self._arrivals = check, track.stamps_ns + delay
        self._idling = idling
        self.name, self._track, self._next = name, track, 0

    def contact_at(self, stamp: int, surface: Surface | None = None) -> Contact | None:
        """Give the poses that have arrived by an image [ns] to the estimator, and return its contact.

        Raises:
            RecordingError: the estimator refuses a pose.
        """
        T_jaw_camera = self._track.camera and self._track.camera.at(stamp)
        if T_jaw_camera is not None:
            self.follow_jaw(T_jaw_camera)
        while self._next < len(self._arrivals) and self._arrivals[self._next] <= stamp + ROUNDING:
            self._take_recorded(self._next)
            self._next += 1
        if self._check is not None:
            self.estimator.contradiction = self._check.at(stamp)
        if self._idling is None:
            return super().contact_at(stamp, surface)
        if self._idling.passes(stamp):
            return self.last.estimate.contact
        contact = super().contact_at(stamp, surface)
        self._idling.note(stamp, self.is_out_of_reach)
        return contact

    def _take_recorded(self, index: int) -> None:
        """Give one pose to the estimator."""
        stamp, T, camera = int(self._track.stamps_ns[index]), self._track.poses[index], None
        if self._track.camera is not None:
            T_jaw_camera = self._track.camera.at(stamp)
            T, camera = self.as_now(T, T_jaw_camera), T_jaw_camera[:3, 3]
        try:
            self.take_pose(stamp, T, camera=camera)
        except PoseError as error:
            raise RecordingError(f"object pose at {SECOND * stamp:.3f} s: {error}") from error


class RecordedCheck:
    """The mesh of a recording compared with its depth images, as the contact estimator's node compares it live.

    Without depth, its outline is compared with edges in colour.

    Args:
        recording: with images.
        mesh: of the object.
        track: its poses in the camera's frame at stamps of the images.
        at_once: compare as few images as a verdict needs, of all that there are; edges in colour show less than depth.
    """

    def __init__(self, recording: Recording, mesh: Any, track: ObjectTrack, *, at_once: bool = False) -> None:
        from finforce_contact.pose.edge_check import EdgeCheck
        from finforce_contact.pose.mesh_check import LEAST_IMAGES, MOST_IMAGES, MeshCheck, is_due

        kind = MeshCheck if recording.images.has_depth else EdgeCheck
        self._check, self._least = kind(mesh, recording.images.camera), LEAST_IMAGES
        chosen: list[int] = []
        if at_once:
            count = LEAST_IMAGES if recording.images.has_depth else MOST_IMAGES
            chosen += np.unique(np.linspace(0, len(track.stamps_ns) - 1, count).astype(int)).tolist()
        for index, stamp in enumerate(() if at_once else track.stamps_ns.tolist()):
            if is_due(len(chosen), SECOND * (stamp - track.stamps_ns[chosen[-1]]) if chosen else math.inf):
                chosen.append(index)
        self._poses = dict(zip(track.stamps_ns[chosen].tolist(), track.poses[chosen], strict=True))
        self._images, self._left = iter(recording.images.at(track.stamps_ns[chosen])), deque(self._poses)

    @property
    def is_sure(self) -> bool:
        """True if there are images enough for a verdict."""
        return len(self._poses) >= self._least

    @property
    def sees_mesh(self) -> bool:
        """True if the images compared so far show enough of the mesh for a verdict."""
        return bool(self._check.sees_mesh)

    def at(self, stamp: int) -> str:
        """Return what contradicts the mesh by the first images and those up to a stamp [ns], "" for nothing.

        Raises:
            RecordingError: an image is damaged.
        """
        while self._left and (self._left[0] <= stamp or len(self._poses) - len(self._left) < self._least):
            shown = next(self._images, None)
            while self._left and (shown is None or self._left[0] <= shown.stamp):  # of a video some cannot be made
                self._left.popleft()
            if shown is not None:
                with suppress(ImageError):  # without any depth
                    pixels = shown.image.color if shown.image.depth is None else shown.image.depth
                    self._check.add(pixels, self._poses[shown.stamp])
        return self._check.contradiction


def check_mesh(recording: Recording, mesh: Any, *, at_once: bool = False) -> RecordedCheck | None:
    """Return the comparison of a mesh with the images of a recording; None without images and poses of one frame.

    See `RecordedCheck`.
    """
    track = pose_object_in_images(recording, POSE_TOLERANCE)
    if track is None or not len(track.stamps_ns):
        return None
    return RecordedCheck(recording, mesh, track, at_once=at_once)


# Least number of poses from which the location of first touch is averaged.
LEAST_POSES = 3


def build_source(
    choice: ContactChoice, recording: Recording, jaw: Jaw, mesh: str = "default", *, as_live: bool = False
) -> ContactSource:
    """Return a fresh contact source for one jaw of a recording.

    Args:
        choice: contact that was asked for.
        recording: it tells height, or mesh and poses.
        jaw: the jaw of that side, as calibrated.
        mesh: mesh density of the solver, whose surface the paper's method gets.
        as_live: True if images are passed over as by the contact estimator's node.

    Raises:
        FinforceError: height, mesh or poses are missing or cannot be used.
    """
    mode = choice.mode_for(recording, jaw.side)
    if mode == FIXED:
        height = choice.height(recording)
        return GivenContact(Contact.fixed(jaw, height), f"fixed:{1e3 * height:g}")
    estimator = build_estimator(choice, mode, recording, jaw, mesh)
    track, idling = track_object(recording, jaw.side), Idling() if as_live else None
    check = check_mesh(recording, estimator.mesh) if choice.compare_mesh else None
    return RecordedContact(estimator, track, mode, idling, check, choice.pose_delay)


def build_estimator(choice: ContactChoice, mode: str, recording: Recording, jaw: Jaw, mesh: str = "default") -> Any:
    """Return a fresh contact estimator that knows the object of a recording.

    Raises:
        RecordingError: no object mesh.
        ObjectMeshError: the mesh cannot be used.
        MissingDependencyError: a library that reads or cuts meshes is not installed.
    """
    from finforce_contact.estimator import ContactEstimator
    from finforce_contact.parameters import ContactSettings

    path = require_mesh(recording, choice.object_file)
    body = _load_object(path, choice.object_unit, path.stat().st_mtime_ns if path.exists() else 0)
    return ContactEstimator(jaw, mesh=body, settings=ContactSettings(mode=mode, mesh=mesh))


@lru_cache(maxsize=4)
def _load_object(path: Path, unit: str, changed: int) -> Any:
    """Return the mesh of a file, as long as that stays the same, and print what was done to it once."""
    from finforce_contact.mesh.object_mesh import load_object_mesh

    body = load_object_mesh(path, unit=unit)
    for note in body.notes:
        print(f"note: {body.name}: {note}", file=sys.stderr)
    return body


def first_touch(choice: ContactChoice, recording: Recording, jaw: Jaw, mesh: str = "default") -> Contact:
    """Return the contact of a whole recording: where its object first touches the undeformed jaw.

    By estimation it is found from the average of the poses before the true force rises, which pose noise of n samples
    enters with 1/sqrt(n) of its size only.

    Args:
        choice: contact that was asked for.
        recording: with ground truth.
        jaw: the jaw of that side.
        mesh: mesh density of the solver.

    Returns:
        One free point, with the object's outline where the contact estimator gives one.

    Raises:
        FinforceError: height, mesh or poses are missing or cannot be used.
    """
    mode = choice.mode_for(recording, jaw.side)
    if mode not in ESTIMATED:
        return Contact.fixed(jaw, choice.height(recording))
    estimator = build_estimator(choice, mode, recording, jaw, mesh)
    track = _before_load(track_object(recording, jaw.side), recording, jaw.side)
    stamp = float(track.stamps_ns[-1] * 1e-9)
    estimator.take_pose(stamp, mean_pose(track.poses))
    estimate = estimator.update(stamp)
    if estimate.contact is None or not len(estimate.contact.points):
        raise RecordingError(f"{recording.name}: no location of first touch: {estimate.message or estimate.status}")
    found = estimate.contact
    point = np.average(found.points, axis=0, weights=found.weights)
    return Contact(points=point[None], weights=np.ones(1), touching=False, free=True, outline=found.outline)


def _before_load(track: ObjectTrack, recording: Recording, side: str) -> ObjectTrack:
    """Return the poses before the true force rises.

    Raises:
        RecordingError: there are hardly any.
    """
    truth = recording.truth(side)
    loaded = np.flatnonzero(np.linalg.norm(truth.force, axis=1) > ONSET_FORCE)
    begin = truth.stamps_ns[loaded[0]] if loaded.size else track.stamps_ns[-1] + 1
    early = track.stamps_ns < begin
    if early.sum() < LEAST_POSES:
        raise RecordingError(
            f"{recording.name}: {early.sum()} object poses before the force rises; expected at least {LEAST_POSES}"
        )
    return ObjectTrack(stamps_ns=track.stamps_ns[early], poses=track.poses[early])


ESTIMATED = ("estimate", "closest", "paper")
POSE_TOLERANCE = round(ContactParameters().pose_tolerance / SECOND)  # [ns]
UNCOMPARED = "is not compared: that needs images, and /object_pose in their frame"
UNSEEN = (
    "is not seen where its poses have it: check their unit and frame, and that they are not inverted, or give images "
    "that show it"
)
OUTLINED = "is compared with edges in colour, for want of depth: only turns by right angles are told"
AUTOMATIC, FIXED = "automatic", "fixed"
FROM_CASE = "case"
METRES = 0.5  # below it a height in millimetres was meant in metres: no jaw is touched so near to its clamp
EXPECTED = f"expected {', '.join(ESTIMATED)}, fixed:Z_MM (millimetres), fixed:case or NAME=Z_MM"


@dataclass(frozen=True, kw_only=True)
class ContactChoice:
    """The source of the contact of a recording.

    Attributes:
        mode: "estimate", "closest" or "paper" by the contact estimator; "fixed" at a height; "automatic" is "estimate"
            for a recording with an object mesh and poses, else "fixed".
        height_mm: height for every recording [mm]; None takes it from each recording's `case.json`.
        by_name: recording name -> height [mm], before everything else.
        object_file: mesh for every recording; None takes it from each recording's `case.json`.
        object_unit: unit of the mesh.
        compare_mesh: True if the mesh is compared with the depth images.
        pose_delay: from the stamp of a pose to its arrival [ns].
    """

    mode: str = AUTOMATIC
    height_mm: float | None = None
    by_name: Mapping[str, float] = field(default_factory=dict)
    object_file: str | None = None
    object_unit: str = "m"
    compare_mesh: bool = True
    pose_delay: int = 0

    def mode_for(self, recording: Recording, side: str) -> str:
        """Return "estimate", "closest", "paper" or "fixed" for one jaw of a recording."""
        if recording.name in self.by_name:
            return FIXED
        if self.mode != AUTOMATIC:
            return self.mode
        is_known = has_object(recording, side) and find_mesh(recording, self.object_file) is not None
        return ESTIMATED[0] if is_known else FIXED

    def check(self, recording: Recording) -> None:
        """Refuse a recording whose contact cannot be known, before its images are looked at.

        Raises:
            FinforceError: height or mesh are missing.
        """
        for side in recording.jaws:
            if self.mode_for(recording, side) == FIXED:
                self.height(recording)
            else:
                require_mesh(recording, self.object_file)

    def describe_comparison(self, recording: Recording) -> list[str]:
        """Return that the mesh is not compared with depth images, in a sentence; empty where it is, or need not be."""
        modes = {self.mode_for(recording, side) for side in recording.jaws}
        if modes == {FIXED} or not self.compare_mesh:
            return []
        compared = pose_object_in_images(recording, POSE_TOLERANCE)
        if compared is None or not len(compared.stamps_ns):
            return [f"the object's mesh {UNCOMPARED}; a wrong one gives wrong forces"]
        return [] if recording.images.has_depth else [f"the object's mesh {OUTLINED}; a wrong one gives wrong forces"]

    def height(self, recording: Recording) -> float:
        """Return the height of first touch above the clamped base for a recording [m].

        Raises:
            OptionError: an estimator was asked for, or no height was given and the `case.json` holds none.
        """
        if recording.name in self.by_name:
            return self.by_name[recording.name] * 1e-3
        if self.mode in ESTIMATED:
            raise OptionError(f"--contact {self.mode} has no fixed height; here give fixed:Z_MM or fixed:case")
        if self.height_mm is not None:
            return self.height_mm * 1e-3
        if self.object_file is not None and self.mode == AUTOMATIC:
            raise OptionError(
                f"{recording.name}: --object needs poses of the object: expected PoseStamped on /object_pose, in the "
                "frame of the images (those of tags on /tf are not read); or give --contact fixed:Z_MM"
            )
        case_object = recording.case.get("object")
        z = case_object.get("z") if isinstance(case_object, Mapping) else None
        if isinstance(z, bool) or not isinstance(z, int | float) or not math.isfinite(z):
            raise OptionError(
                f"{recording.name}: no contact height: no object.z in a case.json next to it; give --contact fixed:Z_MM"
            )
        return float(z) * 1e-3


def choose_contact(height: float | None, object_file: str | Path | None) -> ContactChoice:
    """Return a contact at a height [m], by a mesh and its recorded poses, or with neither as each recording states it.

    Raises:
        OptionError: both were given.
    """
    if height is not None and object_file is not None:
        raise OptionError("contact_height and object_mesh: expected one of the two")
    if height is not None:
        return ContactChoice(mode=FIXED, height_mm=1e3 * height)
    return ContactChoice(object_file=None if object_file is None else str(object_file))


def parse_contacts(texts: Sequence[str], **chosen: Any) -> ContactChoice:
    """Read `--contact` values: an estimator, `fixed:Z_MM`, `fixed:case`, or `NAME=Z_MM`, the last repeatable.

    Args:
        texts: the values; of those for every recording the last one counts.
        **chosen: other fields of the choice.

    Raises:
        OptionError: another value.
    """
    by_name: dict[str, float] = {}
    mode, height = AUTOMATIC, None
    for text in texts:
        name, separator, value = text.rpartition("=")
        if separator:
            by_name[name] = _height(value, text)
        elif text.startswith("fixed:"):
            value = text.removeprefix("fixed:")
            mode, height = FIXED, None if value == FROM_CASE else _height(value, text)
        elif text in ESTIMATED:
            mode = text
        else:
            raise OptionError(f"--contact {text}: {EXPECTED}")
    return ContactChoice(mode=mode, height_mm=height, by_name=by_name, **chosen)


def _height(value: str, text: str) -> float:
    """Read a height [mm]."""
    try:
        height = float(value)
    except ValueError:
        height = math.nan
    if not math.isfinite(height):
        raise OptionError(f"--contact {text}: '{value}' is not a height in millimetres")
    if 0.0 < height < METRES:
        raise OptionError(f"--contact {text}: expected millimetres, such as {text.replace(value, f'{1e3 * height:g}')}")
    return height
