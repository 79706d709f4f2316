"""What an offline run needs beside the recordings: jaw, settings, calibration, contact; and the run itself."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial

from finforce.errors import FinforceError
from finforce_contact.loop import ContactSource
from finforce_eval.errors import OptionError
from finforce_eval.evaluation.contact_source import ContactChoice, build_source, parse_contacts
from finforce_eval.evaluation.evaluate import Evaluation, check_keypoint_count, evaluate_recording, score_results
from finforce_eval.evaluation.keypoint_source import parse_source
from finforce_eval.evaluation.manipulation import with_distances
from finforce_eval.evaluation.results import parse_changes
from finforce_eval.machine import version
from finforce_eval.recordings.bags import name_recordings
from finforce_eval.recordings.images import PAIRED
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.tracks import JAWS, Recording
from finforce_eval.table import ForceSeries
from finforce_ifea.estimator import JawEstimator
from finforce_ifea.jaw.calibration import Calibration, load_calibration
from finforce_ifea.jaw.jaw import Jaw, load_jaw
from finforce_ifea.settings import EstimatorSettings


@dataclass(frozen=True, kw_only=True)
class EvaluationSetup:
    """What an offline run needs beside the recordings."""

    jaw: Jaw
    settings: EstimatorSettings
    calibration: Calibration | None
    contacts: ContactChoice
    about: Mapping[str, str]

    def side(self, side: str) -> EvaluationSetup:
        """Return the setup of the left or the right jaw; a jaw file describes the left one."""
        return self if side == self.jaw.side else replace(self, jaw=self.jaw.mirrored())

    def estimator(self, held: bool = False) -> JawEstimator:
        """Return a fresh estimator that has nothing left to compile; `held` where both jaws hold an object."""
        settings = self.settings.resolve_held(both=held)
        estimator = JawEstimator(self.jaw, settings=settings, calibration=self.calibration)
        estimator.warm_up()
        return estimator

    @property
    def density(self) -> str:
        """Mesh density of the surface that the solver returns."""
        return "coarse" if self.settings.solver == "paper" else self.settings.mesh

    def source(self, recording: Recording) -> ContactSource:
        """Return a fresh contact source for this jaw of a recording."""
        jaw = self.calibration.apply(self.jaw) if self.calibration else self.jaw
        return build_source(self.contacts, recording, jaw, self.density)


def read_recordings(
    paths: Sequence[str], pairing: int = PAIRED, sides: Sequence[str] = (), *, strict: bool = False
) -> list[Recording]:
    """Read recordings and give each a name of its own.

    Args:
        paths: of the recordings.
        pairing: greatest distance between the stamps of a colour and a depth image that belong together [ns].
        sides: jaws that are in the images, whether or not a topic tells of them.
        strict: refuse recordings that are damaged.

    Raises:
        RecordingError: one of them cannot be read.
        OptionError: one was given twice.
    """
    recordings = []
    for name, path in name_recordings(paths, "/"):
        recording = replace(read_recording(path, pairing, sides, strict=strict), name=name)
        for note in recording.notes:
            print(f"note: {recording.name}: {note}", file=sys.stderr)
        recordings.append(recording)
    return recordings


def read_keypoints(options: argparse.Namespace, sides: Sequence[str] = ()) -> list[Recording]:
    """Read the recordings with the key points that were asked for.

    Args:
        options: of the command line.
        sides: jaws that are in the images, whether or not a topic tells of them.

    Raises:
        FinforceError: one of them cannot be read, or has no such key points.
    """
    source = parse_source(options)
    recordings = []
    for read in read_recordings(options.bags, source.pairing, sides, strict=source.strict):
        recording = source.apply(read)
        for note in recording.notes[len(read.notes) :]:
            print(f"note: {recording.name}: {note}", file=sys.stderr)
        recordings.append(recording)
    return recordings


def make_setup(options: argparse.Namespace) -> EvaluationSetup:
    """Load what the options name.

    Raises:
        FinforceError: the contact, the jaw or the calibration cannot be used.
    """
    contacts = parse_contacts(
        options.contact,
        object_file=getattr(options, "object", None),
        object_unit=getattr(options, "object_unit", "m"),
    )
    jaw = load_jaw(options.jaw)
    changes = getattr(options, "set", [])
    settings = parse_settings(options.solver, options.mesh, changes)
    calibration = load_calibration(options.calibration) if options.calibration else None
    about = {
        "jaw": jaw.name,
        "solver": options.solver,
        "mesh": options.mesh,
        "keypoints": getattr(options, "source", None) or "keypoints where they were recorded, else images",
        "contact": ", ".join(options.contact) or "estimate where mesh and poses are known, else fixed:case",
        "settings": ", ".join(changes) or "as they come",
        "calibration": options.calibration or "none",
        "version": version(),
    }
    return EvaluationSetup(jaw=jaw, settings=settings, calibration=calibration, contacts=contacts, about=about)


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


def evaluate_all(recordings: Sequence[Recording], setup: EvaluationSetup) -> Evaluation:
    """Evaluate every jaw with ground truth of every recording.

    Raises:
        FinforceError: one of them cannot be evaluated.
    """
    results = [result for recording in recordings for result in evaluate_jaws(recording, setup)]
    return score_results(results, recordings)


def evaluate_jaws(
    recording: Recording,
    setup: EvaluationSetup,
    build: Callable[[str, bool], JawEstimator] | None = None,
    *,
    shown: bool = True,
) -> tuple[ForceSeries, ...]:
    """Evaluate every jaw with ground truth of a recording.

    Args:
        recording: with key points and truth.
        setup: jaw, settings, calibration and contact.
        build: gives an estimator of a side that knows nothing yet, and whether both jaws hold; new ones without.
        shown: under a progress bar.

    Raises:
        FinforceError: it cannot be evaluated.
    """
    from tqdm import tqdm

    sides = truth_sides(recording)
    for side in sides:
        check_keypoint_count(recording, side, setup.jaw)
    both, results = len(sides) == len(JAWS), []
    frames = sum(len(recording.jaw(side).keypoints.stamps) for side in sides)
    hidden = None if shown else True
    with tqdm(total=frames, unit="frame", desc=recording.name, disable=hidden, leave=False) as bar:
        for side in sides:
            own = setup.side(side)
            result = evaluate_recording(
                recording,
                own.jaw,
                own.source(recording),
                side=side,
                factory=partial(build, side, both) if build else partial(own.estimator, both),
                progress=bar.update,
            )
            results.append(result.renamed(f"{recording.name}/{side}") if both else result)
    return tuple(with_distances(dict(zip(sides, results, strict=True)), recording).values() if both else results)


def truth_sides(recording: Recording) -> list[str]:
    """Return the jaws of a recording that have ground truth.

    Raises:
        RecordingError: there is none.
    """
    sides = [side for side, track in recording.jaws.items() if track.truth is not None]
    if not sides:
        recording.truth(next(iter(recording.jaws)))
    return sides
