"""A set of cases that are run one after the other, kept one by one, and put on a page together.

Those of grasps are scenes of the twin or recordings of one's own, read with key points and scored.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import rmtree
from typing import Any

import pandas as pd
from numpy.typing import NDArray

from finforce.errors import FinforceError
from finforce.gripper_frames import SIDES
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.contact_source import ContactChoice
from finforce_eval.evaluation.keypoint_source import KeypointSource
from finforce_eval.evaluation.scoring import Evaluation
from finforce_eval.evaluation.setup import EvaluationSetup, hash_files
from finforce_eval.figures.figures import new_figure, style_axes
from finforce_eval.machine import commit, version, write_figures
from finforce_eval.recordings.bags import bag_source, list_files
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.tracks import Recording
from finforce_eval.table import AXES
from finforce_eval.tasks import OK, EngineOptions, Manifest, Task, hash_settings, run_tasks
from finforce_ifea.jaw.calibration import load_calibration
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.settings import EstimatorSettings
from lab.harness import Figures, figures_json, format_figures
from lab.scenes import TwinScene, find_scene

RECORDINGS = "recordings"


@dataclass(frozen=True, kw_only=True)
class Case:
    """One run of an experiment.

    Attributes:
        name: unlike the others', and a part of file names.
        settings: that decide its figures, as JSON has them; what stands under `words` becomes part of them.
    """

    name: str
    settings: Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """The settings with which recordings are solved.

    Attributes:
        bags: recordings of one's own; none for scenes of the twin.
        jaw: shipped name or jaw file.
        calibration: shipped name or file; empty for the jaw file's own material.
        source: of the key points, see `KeypointSource`; empty for images of the twin, and for what bags have.
        seed: of the first scene.
        size: of the twin's images, WIDTHxHEIGHT.
        quick: few and small cases.
        network: checkpoint of the baseline network.
    """

    bags: Sequence[str] = ()
    jaw: str = "bench"
    calibration: str = "twin"
    source: str = ""
    seed: int = 100
    size: str = "640x480"
    quick: bool = False
    network: str = ""

    @property
    def shared(self) -> dict[str, Any]:
        """The settings that every case has."""
        files = hash_files((self.jaw, self.calibration, self.network))
        return {"jaw": self.jaw, "calibration": self.calibration, "source": self.source, "files": files}

    def scene_case(self, name: str, scene: str, changes: Mapping[str, Any], number: int, **more: Any) -> Case:
        """Return a case that is a scene of the twin; `more` is kept in its settings, too."""
        made = {"scene": scene, "changes": dict(changes), "seed": self.seed + number, "size": self.size}
        return Case(name=name, settings=self.shared | made | more)

    def bag_cases(self) -> list[Case]:
        """Return the recordings of one's own as cases; see `read_bags`."""
        return [case for case, _ in self.read_bags()]

    def read_bags(self, needed: Sequence[str] = SIDES) -> list[tuple[Case, Recording]]:
        """Return the recordings of one's own, each as a case and as it was read.

        Args:
            needed: jaws whose measured force, and about which the object's poses, an experiment cannot do without.

        Raises:
            RecordingError: a recording lacks something, and which it is.
        """
        read = []
        for bag in self.bags:
            recording = read_recording(bag)
            missing = list_missing(recording, needed)
            if missing:
                raise RecordingError(f"{bag}: this experiment needs {'; '.join(missing)}, which is not in it")
            source = bag_source(Path(bag))
            files = sorted(source.glob("*")) if source.is_dir() else [source]
            size = sum(path.stat().st_size for path in files)
            settings = self.shared | {"bag": str(bag), "bytes": size}
            read.append((Case(name=recording.name, settings=settings), recording))
        return read

    @contextmanager
    def open_case(self, case: Case, folder: Path) -> Iterator[Recording]:
        """Give the recording of a case with its key points; a scene is rendered first, and forgotten once it is scored.

        Raises:
            FinforceError: the scene cannot be rendered, the recording not be read, or no key points are found.
        """
        settings, source = case.settings, case.settings["source"]
        is_own = "bag" in settings
        if is_own:
            bag = Path(settings["bag"])
        else:
            about = {name: settings[name] for name in ("changes", "seed", "size", "lens") if name in settings}
            scene = TwinScene(scenario=settings["scene"], **about)
            bag, source = find_scene(scene, folder / RECORDINGS), source or "images"
        detector = settings.get("detector", {})
        yield KeypointSource(source=source, jaw_file=settings["jaw"], parameters=detector).apply(read_recording(bag))
        if not is_own:
            rmtree(bag, ignore_errors=True)


def list_missing(recording: Recording, needed: Sequence[str]) -> list[str]:
    """Return what a recording lacks: measured forces of jaws, or the object's poses."""
    sides = [side for side in needed if side not in recording.jaws or recording.jaws[side].truth is None]
    missing = [f"/{side}/ground_truth_wrench" for side in sides]
    return missing if recording.object_pose is not None else [*missing, "/object_pose"]


def build_setup(
    settings: Mapping[str, Any], contact: ContactChoice | None = None, estimator: EstimatorSettings | None = None
) -> EvaluationSetup:
    """Return the setup that a case's settings name.

    Args:
        settings: of the case.
        contact: estimated by default.
        estimator: its settings; defaults without.

    Raises:
        FinforceError: jaw or calibration cannot be used.
    """
    return EvaluationSetup(
        jaw=load_jaw(settings["jaw"]),
        settings=estimator or EstimatorSettings(),
        calibration=load_calibration(settings["calibration"]) if settings["calibration"] else None,
        contacts=contact or ContactChoice(mode="estimate"),
        about={},
    )


SHARP = {f"sharpness {axis}": f"sharp {axis}" for axis in AXES}  # headings by column of `tabulate`


def axis_sharpness(evaluation: Evaluation) -> dict[str, float | None]:
    """Return how sharp the stated deviations of all jaws' forces were along x, y and z, see `Stats.sharpness`."""
    return dict(zip(AXES, evaluation.total.all.sharpness or (None,) * 3, strict=True))


def keep_poses(recording: Recording, seen: NDArray) -> Recording:
    """Return a recording with those poses of the object (n,) alone that are seen."""
    track = recording.object_pose
    kept = {name: getattr(track, name)[seen] for name in ("stamps_ns", "position", "quaternion")}
    return replace(recording, object_pose=replace(track, **kept))


PAGE = "README.md"


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """An experiment; its cases are run in their order.

    Attributes:
        name: of the command line.
        title: of the page.
        about: summary, with the differences from the paper's own.
        list_cases: returns what is to be run; raises FinforceError where recordings lack what the experiment needs.
        run: returns the figures of a case as JSON has them, those that are only drawn under `drawn`; files go into a
            folder of the experiment's own.
        find: returns what the figures of the cases, by name, say together; pictures of it go into the folder.
    """

    name: str
    title: str
    about: str
    list_cases: Callable[[RunOptions], Sequence[Case]]
    run: Callable[[RunOptions, Case, Path], dict[str, Any]]
    find: Callable[[RunOptions, Mapping[str, Mapping[str, Any]], Path], Figures]


def run_case(experiment: Experiment, options: RunOptions, case: Case, folder: str) -> dict[str, Any]:
    """Return the figures of a case; files go into the experiment's folder.

    Raises:
        FinforceError: it has none.
    """
    return {**case.settings.get("words", {}), **experiment.run(options, case, Path(folder))}


def _list_inputs(settings: Mapping[str, Any]) -> list[Path]:
    """Return the files that a case reads: of its recording, its jaw and its calibration, if it has some."""
    return [*map(Path, settings.get("files", ())), *(list_files(Path(settings["bag"])) if "bag" in settings else ())]


def run_experiment(
    experiment: Experiment, options: RunOptions, report: Path, engine: EngineOptions | None = None
) -> Figures:
    """Run what is not done yet of an experiment, and write `NAME.json`, pictures and a page into `report/NAME`.

    A case that fails is told of, costs itself only, and is tried again by the next run.

    Args:
        experiment: the experiment to run.
        options: settings of the run.
        report: folder of all experiments.
        engine: where the cases are run; here, one after the other, without.

    Returns:
        What the cases say together.

    Raises:
        FinforceError: the cases cannot be listed, or none of them gave figures.
    """
    folder = report / experiment.name
    cases = experiment.list_cases(options)
    manifest = Manifest(folder)
    given = [{"experiment": experiment, "options": options, "case": case, "folder": str(folder)} for case in cases]
    code = {"version": version(), "commit": commit()}
    tasks = [
        Task(
            name=case.name,
            key=hash_settings(code | dict(case.settings)),
            work=run_case,
            given=each,
            files=_list_inputs(case.settings),
        )
        for case, each in zip(cases, given, strict=True)
    ]
    with manifest.alone():
        lines = run_tasks(tasks, engine or EngineOptions(), manifest, unit="case")
    failed = {line["name"]: line["error"] for line in lines if line["status"] != OK}
    for name, error in failed.items():
        print(f"failed: {name}: {error}", file=sys.stderr)
    figures = {line["name"]: line["figures"] for line in lines if line["status"] == OK}
    if not figures:
        raise FinforceError(f"{experiment.name}: not one of {len(cases)} cases gave figures; the first: "
                            f"{next(iter(failed.values()), 'there are none')}")  # fmt: skip
    findings = experiment.find(options, figures, folder)
    about = {"version": version(), "cases": len(cases), "failed": failed, **figures_json(findings)}
    about["figures"] = {name: _without_drawn(row) for name, row in figures.items()}
    write_figures(folder / f"{experiment.name}.json", {experiment.name: about})
    (folder / PAGE).write_text(_write_page(experiment, findings, len(cases), failed), encoding="utf-8")
    return findings


def tabulate(figures: Mapping[str, Mapping[str, Any]]) -> pd.DataFrame:
    """Return a row for each case, nested figures in columns of their own ("rmse_N load"), without what is drawn."""
    table = pd.json_normalize([_without_drawn(row) for row in figures.values()], sep=" ")
    table.insert(0, "case", list(figures))
    return table


def average(table: pd.DataFrame, by: Sequence[str], columns: Mapping[str, str]) -> pd.DataFrame:
    """Return the number of rows, and mean and standard deviation of some columns, by groups in their order.

    Args:
        table: of `tabulate`.
        by: columns that tell the groups apart.
        columns: headings of the averages by column.
    """
    groups = table.groupby(list(by), sort=False)
    means = groups.size().rename("n").to_frame()
    for column, heading in columns.items():
        values = groups[column]
        means[heading], means[f"±{heading}"] = values.mean(), values.std(ddof=0)
    return means.reset_index()


def _without_drawn(row: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in row.items() if name != "drawn"}


def _write_page(experiment: Experiment, findings: Figures, cases: int, failed: Mapping[str, str]) -> str:
    """Return the page of an experiment."""
    done = f"{cases - len(failed)} of {cases} cases, finforce {version()}."
    lines = [f"# {experiment.title}", "", experiment.about, "", done]
    lines += [f"- **failed:** {name}: {text}" for name, text in failed.items()]
    lines += ["", format_figures(findings), ""]
    lines += [f"![{caption}]({name})" for caption, name in findings.drawn.items()]
    return "\n".join(lines) + "\n"


def draw_panels(titles: Sequence[str], columns: int, up: str, draw: Callable[[Any, str], None]) -> Any:
    """Return a figure with a panel over time for each title, `columns` side by side.

    Args:
        titles: of the panels.
        columns: panels in a row.
        up: label of the first panels' axes.
        draw: draws into the axes of a title.
    """
    rows = -(-len(titles) // columns)
    figure = new_figure(3.6 * columns, 2.5 * rows + 0.4)
    grid = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for axes in grid.flat[len(titles) :]:
        axes.set_visible(False)
    for axes, title in zip(grid.flat, titles, strict=False):
        style_axes(axes)
        axes.set_title(title, loc="left", fontsize=9)
        draw(axes, title)
    for axes in grid[:, 0]:
        axes.set_ylabel(up)
    for axes in grid[-1]:
        axes.set_xlabel("after first touch [s]")
    return figure
