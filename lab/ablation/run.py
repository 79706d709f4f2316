"""Runs scenes with one rule switched off, in a process whose compiled code knows the other values.

Numba keeps the values of module attributes in the code that it compiles. So the process of a rule that is compiled in
begins with all compiled code but that, replaces the attributes, and compiles the rest anew. The others share a process.
"""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import reduce
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd
from numba.core.dispatcher import Dispatcher
from numpy.typing import NDArray

from finforce_eval.errors import RecordingError
from finforce_eval.tasks import progress_bar
from finforce_ifea.estimator import ForceEstimator
from finforce_ifea.jaw.calibration import Calibration
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.settings import EstimatorSettings
from lab.ablation.rules import RULES, Rule
from lab.ablation.scenes import Scene, build_scene
from lab.harness import Figures, format_table
from lab.stress import inputs, objects
from lab.stress.session import FORCE_ERROR, Bench
from lab.stress.stress import Plan, run_family

SIGMAS = 3.0
# What counts as moved: forces [N], shares [%].
MOVED_FORCE, MOVED_SHARE = 0.01, 1.0
# Prefix of a scene that is a family of the stress tests.
STRESS = "stress "
FAMILIES = {family.name: family for family in (*inputs.FAMILIES, *objects.FAMILIES)}
# `--count` of such a family.
TRIALS = 12
COLUMNS = ("magnitude/N", "vector/N", "in 3σ/%", "answered/%")


def find_compiled(rule: Rule) -> tuple[str, ...]:
    """Return the beginnings of the file names under which Numba keeps what a rule is compiled into."""
    places = [place.partition(":")[::2] for place in rule.off]
    for name, _ in places:
        import_module(name)
    modules = [module for name, module in sys.modules.items() if name.startswith("finforce")]
    compiled = {each.py_func for module in modules for each in vars(module).values() if isinstance(each, Dispatcher)}
    stale = {each for each in compiled if any(each.__module__ == name and attribute in each.__code__.co_names
                                              for name, attribute in places)}  # fmt: skip
    while callers := {each for each in compiled - stale if {own.__name__ for own in stale} & {*each.__code__.co_names}}:
        stale |= callers
    return tuple(f"{each.__module__.rpartition('.')[2]}.{each.__name__}-" for each in stale)


def link_compiled(rule: Rule, folder: Path) -> None:
    """Fill a folder with all compiled code but that which a rule is compiled into."""
    stale = find_compiled(rule)
    for path in Path(os.environ["NUMBA_CACHE_DIR"]).glob("*/*.nb?"):
        if not path.name.startswith(stale):
            (folder / path.parent.name).mkdir(exist_ok=True)
            (folder / path.parent.name / path.name).symlink_to(path)


@contextmanager
def switch_off(rule: Rule) -> Iterator[None]:
    """Replace the attributes of a rule; what is compiled in has to be replaced before it is compiled.

    Raises:
        AttributeError: a place is gone.
    """
    before = []
    for place, value in rule.off.items():
        name, _, path = place.partition(":")
        *owners, attribute = path.split(".")
        owner = reduce(getattr, owners, import_module(name))
        before.append((owner, attribute, getattr(owner, attribute)))
        setattr(owner, attribute, value)
    yield
    for owner, attribute, value in before:
        setattr(owner, attribute, value)


def play(scene: Scene) -> dict[str, float]:
    """Return the figures of a scene: root mean square errors [N], shares [%]."""
    calibration = Calibration(
        young_modulus=load_jaw("bench").material.young_modulus, force_error=FORCE_ERROR, clamped_z=0.0,
        relaxation=scene.relaxation,
    )  # fmt: skip
    settings = EstimatorSettings(**scene.settings)
    estimator = ForceEstimator("bench", settings=settings, calibration=calibration)
    answers = [estimator.update(*each) for each in zip(scene.images, scene.contacts, strict=True)]
    rows = [i for i in range(settings.tare_frames, len(answers)) if answers[i].trusted]
    due = len(answers) - settings.tare_frames
    if not rows:
        return dict(zip(COLUMNS, (np.nan, np.nan, np.nan, 0.0), strict=True))
    found, true = np.array([answers[i].force for i in rows]), scene.forces[rows]
    size = np.linalg.norm(found, axis=1) - np.linalg.norm(true, axis=1)
    return _score(size, found - true, np.array([answers[i].force_stddev for i in rows]), len(rows) / due)


def play_stress(family: str) -> dict[str, float]:
    """Return the figures of a family of the stress tests, as `play` does."""
    trials = run_family(FAMILIES[family], Plan(count=TRIALS))
    sure = [trial for trial in trials if trial.sure and trial.errors]
    if not sure:
        return dict(zip(COLUMNS, (np.nan, np.nan, np.nan, 0.0), strict=True))
    errors, stated = (np.array([getattr(trial, name) for trial in sure]) for name in ("errors", "stated"))
    return _score(errors[:, 3], errors[:, :3], stated[:, :3], len(sure) / len(trials))


def _score(size: NDArray, error: NDArray, sigma: NDArray, answered: float) -> dict[str, float]:
    """Return the figures for errors of magnitude (n,) and force (n, 3) [N] and its standard deviation (n, 3) [N]."""
    within = (np.abs(error) <= SIGMAS * sigma + 1e-3).mean(axis=0).min()
    rms = [float(np.sqrt(np.mean(each**2))) for each in (size, np.linalg.norm(error, axis=1))]
    return dict(zip(COLUMNS, (*rms, 100.0 * float(within), 100.0 * answered), strict=True))


def play_recordings(bags: Iterable[str], options: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Return the figures of recordings, by name, as `finforce evaluate` has them."""
    from finforce_eval.cli.main import parse
    from finforce_eval.evaluation.batch import evaluate_all
    from finforce_eval.evaluation.keypoint_source import parse_source
    from finforce_eval.evaluation.setup import make_setup, read_recordings

    words = [word for name, value in options.items() for word in (f"--{name}", value)]
    asked = parse(["evaluate", *bags, *words])
    evaluation = evaluate_all(read_recordings(asked.bags, parse_source(asked)), make_setup(asked))
    figures = {}
    for name, score in evaluation.scores.items():
        stats = score.all
        values = stats.rmse_N, stats.vector_rmse_N, min(stats.within_3_sigma_pct or [np.nan]), stats.answered_pct
        figures[name] = dict(zip(COLUMNS, map(float, values), strict=True))
    return figures


def run_child(
    rules: Sequence[Rule], scenes: Path, bags: Iterable[str] = (), calibration: str = "bench", names: Iterable[str] = ()
) -> Iterator[dict[str, dict[str, float]]]:
    """Yield the figures of scenes or recordings, by name, for one rule after the other that is off in a process.

    Args:
        rules: of which only a lone one may be compiled in; none for the estimator as it is.
        scenes: folder of the scenes.
        bags: recordings, which are evaluated instead.
        calibration: of the finger of the recordings.
        names: scenes for all rules; those that reach each without.

    Raises:
        RecordingError: the process fails.
    """
    asked = {"folder": str(scenes), "bags": list(bags), "calibration": calibration,
             "rules": [[each.name, list(names or each.scenes)] for each in rules] or [["", list(names)]]}  # fmt: skip
    with TemporaryDirectory(prefix="finforce_ablation_") as folder:
        for rule in rules[:1]:
            link_compiled(rule, Path(folder))
        environment = {**os.environ, "NUMBA_CACHE_DIR": folder if rules else os.environ["NUMBA_CACHE_DIR"]}
        command = [sys.executable, "-m", __spec__.name, json.dumps(asked)]
        with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as child:
            yield from map(json.loads, child.stdout)
    if child.returncode:
        raise RecordingError(f"{', '.join(name for name, _ in asked['rules'])}: status {child.returncode}, see above")


def main() -> None:
    """Print the figures that `run_child` asks for, a line for each rule."""
    asked, known = json.loads(sys.argv[1]), {rule.name: rule for rule in RULES}
    folder = Path(asked["folder"])
    for name, scenes in asked["rules"]:
        with switch_off(known[name]) if name else nullcontext():
            if asked["bags"]:
                figures = play_recordings(asked["bags"], {"calibration": asked["calibration"]})
            else:
                figures = {scene: _play_scene(folder, scene) for scene in scenes}
        print(json.dumps(figures), flush=True)


def _play_scene(folder: Path, name: str) -> dict[str, float]:
    """Return the figures of a scene in a folder, or of a family of the stress tests."""
    family = name.removeprefix(STRESS)
    return play_stress(family) if family != name else play(pickle.loads((folder / name).read_bytes()))


def list_runs(rules: Iterable[Rule]) -> list[list[Rule]]:
    """Return the rules by process: all that are nowhere compiled in together, each other one by itself."""
    plain = [rule for rule in rules if not find_compiled(rule)]
    return [*([plain] if plain else []), *([rule] for rule in rules if rule not in plain)]


def ablate(rules: Iterable[Rule], bags: Iterable[str] = (), calibration: str = "bench") -> Figures:
    """Switch off rules one at a time, and print what each moves as soon as it is known.

    Args:
        rules: to be switched off.
        bags: recordings; the scenes that reach each rule without.
        calibration: of the finger of the recordings.

    Raises:
        FinforceError: a process fails.
    """
    rules, bags = list(rules), list(bags)
    names = [] if bags else list(dict.fromkeys(name for rule in rules for name in rule.scenes))
    steps, rows = sum(not name.startswith(STRESS) for name in names) + len(rules) + 1, []
    with TemporaryDirectory(prefix="finforce_scenes_") as folder, progress_bar(steps, "step", "ablation") as bar:
        bench = Bench(Plan()) if names else None
        for name in (name for name in names if not name.startswith(STRESS)):
            (Path(folder) / name).write_bytes(pickle.dumps(build_scene(bench, name)))
            bar.update(1)
        usual = next(run_child((), Path(folder), bags, calibration, names))
        bar.update(1)
        for each in list_runs(rules):
            for rule, figures in zip(each, run_child(each, Path(folder), bags, calibration), strict=True):
                own = [{"rule": rule.name, "scene": name, **describe(usual[name], figures[name])} for name in figures]
                print(format_table(pd.DataFrame(own)), flush=True)
                rows += own
                bar.update(1)
    told = {rule.name: rule for rule in rules}
    table = pd.DataFrame(sorted(rows, key=lambda row: [*told].index(row["rule"])))
    best = table.loc[table.groupby("rule", sort=False)["moves"].idxmax()].drop(columns="moves")
    best.insert(1, "constant or function", [told[name].implementation for name in best.rule])
    best.insert(2, "purpose", [told[name].purpose for name in best.rule])
    still = [name for name, moved in table.groupby("rule", sort=False)["moves"].max().items() if moved < 1.0]
    notes = [f"Moves nothing: {', '.join(still) or 'none'}."]
    return Figures(tables={"rules": best, "scenes": table}, notes=notes)


def describe(usual: Mapping[str, float], off: Mapping[str, float]) -> dict[str, Any]:
    """Return each figure without a rule beside the usual one, and how many times what counts as moved it changes."""
    scales = (MOVED_FORCE, MOVED_FORCE, MOVED_SHARE, MOVED_SHARE)
    changes = [abs(np.nan_to_num(off[name], nan=0.0) - np.nan_to_num(usual[name], nan=0.0)) / scale
               for name, scale in zip(COLUMNS, scales, strict=True)]  # fmt: skip
    digits = (3, 3, 1, 0)
    shown = {name: f"{usual[name]:.{n}f} → {off[name]:.{n}f}" for name, n in zip(COLUMNS, digits, strict=True)}
    return {**shown, "moves": max(changes)}


if __name__ == "__main__":
    main()
