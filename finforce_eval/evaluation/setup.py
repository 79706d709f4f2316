"""The set-up of an offline run by the command's options: jaw, settings, calibration, contact."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from finforce.caches import FIRST_START, is_compiled
from finforce.errors import FinforceError
from finforce_contact.loop import ContactSource
from finforce_eval.errors import OptionError
from finforce_eval.evaluation.contact_source import ContactChoice, build_source, parse_contacts
from finforce_eval.evaluation.keypoint_source import KeypointSource, parse_changes, parse_source
from finforce_eval.machine import commit, version
from finforce_eval.recordings.bags import name_recordings
from finforce_eval.recordings.tracks import Recording
from finforce_ifea.estimator import ForceEstimator
from finforce_ifea.jaw.calibration import Calibration, load_calibration
from finforce_ifea.jaw.jaw import Jaw, load_jaw
from finforce_ifea.settings import EstimatorSettings

# Options that change nothing in the forces of a recording.
_OUTSIDE = (
    "bags", "out", "workers", "memory", "scheduler", "run", "prefix", "into", "columns", "remove", "json", "report",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class EvaluationSetup:
    """The set-up of an offline run; its estimators are built and compiled once for all recordings.

    With `as_live` the images are left out that the nodes of contact and force leave out; with `stills` every image is
    one by itself; `tares` are those by side that were found for other recordings, by their names.
    """

    jaw: Jaw
    settings: EstimatorSettings
    calibration: Calibration | None
    contacts: ContactChoice
    about: Mapping[str, str]
    as_live: bool = False
    stills: bool = False
    tares: dict[str, Any] = field(default_factory=dict, init=False, repr=False, compare=False)
    _sides: dict[str, EvaluationSetup] = field(default_factory=dict, init=False, repr=False, compare=False)
    _estimators: dict[bool, ForceEstimator] = field(default_factory=dict, init=False, repr=False, compare=False)

    def side(self, side: str) -> EvaluationSetup:
        """Return the setup of the left or the right jaw; a jaw file describes the left one."""
        if side == self.jaw.side:
            return self
        if side not in self._sides:
            self._sides[side] = replace(self, jaw=self.jaw.mirrored())
        return self._sides[side]

    def estimator(self, held: bool = False) -> ForceEstimator:
        """Return the estimator of this jaw, which forgets what it has seen; `held` where both jaws hold an object."""
        if held in self._estimators:
            self._estimators[held].forget()
            return self._estimators[held]
        settings = self.settings.resolve_held(both=held)
        estimator = ForceEstimator(self.jaw, settings=settings, calibration=self.calibration)
        estimator.warm_up()
        self._estimators[held] = estimator
        return estimator

    @property
    def density(self) -> str:
        """Mesh density of the surface that the solver returns."""
        return "coarse" if self.settings.solver == "paper" else self.settings.mesh

    def source(self, recording: Recording) -> ContactSource:
        """Return a fresh contact source for this jaw of a recording."""
        jaw = self.calibration.apply(self.jaw) if self.calibration else self.jaw
        return build_source(self.contacts, recording, jaw, self.density, as_live=self.as_live)


def make_setup(options: argparse.Namespace) -> EvaluationSetup:
    """Load what the options name.

    Raises:
        FinforceError: the contact, the jaw or the calibration cannot be used.
    """
    contacts = read_contacts(options)
    jaw = load_jaw(options.jaw)
    announce_compilation()
    changes = getattr(options, "set", [])
    stills = getattr(options, "stills", False)
    settings = parse_settings(options.solver, options.mesh, changes)
    if stills:  # no picture tells the offsets of another
        settings = replace(settings, automatic_tare=False)
    calibration = load_calibration(options.calibration) if options.calibration else None
    as_live = getattr(options, "as_live", False)
    about = {
        "jaw": jaw.name,
        "solver": options.solver,
        "mesh": options.mesh,
        "keypoints": getattr(options, "source", None) or "keypoints where they were recorded, else images",
        "contact": ", ".join(options.contact) or "estimate where mesh and poses are known, else fixed:case",
        "settings": ", ".join(changes) or "as they come",
        "calibration": options.calibration or "none",
        "images": "each by itself" if stills else "those that the live chain answers" if as_live else "all",
        "version": version(),
    }
    given = {"contacts": contacts, "about": about, "as_live": as_live, "stills": stills}
    return EvaluationSetup(jaw=jaw, settings=settings, calibration=calibration, **given)


@cache
def announce_compilation() -> None:
    """Say, once in a process, that a first start compiles, where nothing was compiled before."""
    if not is_compiled():
        print(f"note: {FIRST_START}", file=sys.stderr, flush=True)


def read_contacts(options: argparse.Namespace) -> ContactChoice:
    """Return where the contact comes from; raises OptionError where the words of --contact say nothing."""
    given = {"object_file": "object", "object_unit": "object_unit", "compare_mesh": "compare_mesh"}
    chosen = {name: getattr(options, option) for name, option in given.items() if hasattr(options, option)}
    return parse_contacts(options.contact, **chosen)


_last: dict[str, EvaluationSetup] = {}


def share_setup(key: str, options: argparse.Namespace) -> EvaluationSetup:
    """Return the setup that the tasks of one process share: that of the call before, where its key was the same.

    Args:
        key: hash of the options and of the files that they name.
        options: of the command line.

    Raises:
        FinforceError: jaw, calibration or settings cannot be used.
    """
    if key not in _last:
        _last.clear()
        _last[key] = make_setup(options)
    return _last[key]


def parse_settings(solver: str, mesh: str, changes: Sequence[str]) -> EstimatorSettings:
    """Return the settings of the estimator with `NAME=VALUE` changes.

    Raises:
        OptionError: a name is unknown, or a value is not of the setting's type or out of its bounds.
    """
    values = parse_changes("--set", "setting", changes, asdict(EstimatorSettings()))
    try:
        return EstimatorSettings(**{"solver": solver, "mesh": mesh, **values})
    except FinforceError as error:
        raise OptionError(f"settings: {error}") from error


def describe_options(options: argparse.Namespace) -> dict[str, Any]:
    """Return all options that forces depend on, hashes of the files that they name, version and commit."""
    chosen = {name: value for name, value in vars(options).items() if name not in _OUTSIDE}
    words = [str(word) for value in chosen.values() for word in (value if isinstance(value, list) else [value])]
    return chosen | {"files": hash_files(words), "version": version(), "commit": commit()}


def hash_files(words: Iterable[str]) -> dict[str, str]:
    """Return hashes of the files that are among some options' words."""
    return {word: sha256(Path(word).read_bytes()).hexdigest() for word in words if _is_file(word)}


def _is_file(word: str) -> bool:
    """Say whether an option's word names a file."""
    try:
        return bool(word) and Path(word).is_file()
    except (OSError, ValueError):
        return False


def read_recordings(paths: Sequence[str], source: KeypointSource) -> list[Recording]:
    """Read recordings as a source asks for, and give each a name of its own.

    Raises:
        RecordingError: one of them cannot be read.
        OptionError: one was given twice.
    """
    recordings = []
    for name, path in name_recordings(paths, "/"):
        recording = replace(source.read(path), name=name)
        print_notes(recording.name, recording.notes)
        recordings.append(recording)
    return recordings


def print_notes(name: str, notes: Iterable[str]) -> None:
    """Print notes on a recording."""
    for note in notes:
        print(f"note: {name}: {note}", file=sys.stderr)


def read_keypoints(options: argparse.Namespace) -> list[Recording]:
    """Read the recordings with the key points that were asked for.

    Raises:
        FinforceError: one of them cannot be read, or has no such key points.
    """
    source, recordings = parse_source(options), []
    for read in read_recordings(options.bags, source):
        recording = source.apply(read)
        print_notes(recording.name, recording.notes[len(read.notes) :])
        recordings.append(recording)
    return recordings
