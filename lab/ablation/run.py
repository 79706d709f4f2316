"""Runs scenes with one rule switched off: each in a process of its own, whose compiled code knows the other values.

Numba keeps the values of module attributes in the code that it compiles. So a process begins with all compiled code but
that which a rule is compiled into, replaces the attributes, and compiles the rest anew.
"""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from collections.abc import Iterable, Mapping
from functools import reduce
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd
from numba.core.dispatcher import Dispatcher

from finforce_eval.errors import RecordingError
from finforce_eval.tasks import progress_bar
from finforce_ifea.estimator import ForceEstimator
from finforce_ifea.jaw.calibration import Calibration
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.settings import EstimatorSettings
from lab.ablation.rules import RULES, Rule
from lab.ablation.scenes import Scene, build_scene
from lab.harness import Figures
from lab.stress.session import FORCE_ERROR, Bench
from lab.stress.stress import Plan

AS_IT_IS = "as it is"
SIGMAS = 3.0
# What counts as moved: forces [N], shares [%].
MOVED_FORCE, MOVED_SHARE = 0.01, 1.0
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


def switch_off(rule: Rule) -> None:
    """Replace the attributes of a rule, before anything that uses them is compiled."""
    for place, value in rule.off.items():
        name, _, path = place.partition(":")
        *owners, attribute = path.split(".")
        owner = reduce(getattr, owners, import_module(name))
        getattr(owner, attribute)  # a place that is gone must not go unnoticed
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
    error, sigma = found - true, np.array([answers[i].force_stddev for i in rows])
    size = np.linalg.norm(found, axis=1) - np.linalg.norm(true, axis=1)
    within = (np.abs(error) <= SIGMAS * sigma + 1e-3).mean(axis=0).min()
    rms = [float(np.sqrt(np.mean(each**2))) for each in (size, np.linalg.norm(error, axis=1))]
    return dict(zip(COLUMNS, (*rms, 100.0 * float(within), 100.0 * len(rows) / due), strict=True))


def play_recordings(bags: Iterable[str], options: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Return the figures of recordings, by name, as `finforce evaluate` has them."""
    from finforce_eval.cli.main import parse
    from finforce_eval.evaluate import evaluate_all
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


def run_child(rule: Rule | None, scenes: Path, names: Iterable[str], bags: Iterable[str], calibration: str) -> Any:
    """Return the figures of scenes and recordings, by name, of a process in which a rule is off.

    Raises:
        RecordingError: the process fails.
    """
    with TemporaryDirectory(prefix="finforce_ablation_") as folder:
        if rule is not None:
            link_compiled(rule, Path(folder))
        asked = {"rule": rule.name if rule else "", "folder": str(scenes), "scenes": list(names), "bags": list(bags),
                 "calibration": calibration}  # fmt: skip
        environment = {**os.environ, "NUMBA_CACHE_DIR": folder} if rule else dict(os.environ)
        done = subprocess.run(
            [sys.executable, "-m", __spec__.name, json.dumps(asked)], env=environment, capture_output=True, text=True
        )
    if done.returncode:
        raise RecordingError(f"{asked['rule'] or AS_IT_IS}: {done.stderr.strip().splitlines()[-1]}")
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Print the figures that `run_child` asks for."""
    asked = json.loads(sys.argv[1])
    for rule in RULES:
        if rule.name == asked["rule"]:
            switch_off(rule)
    figures = {}
    for name in asked["scenes"]:
        figures[name] = play(pickle.loads((Path(asked["folder"]) / name).read_bytes()))
    if asked["bags"]:
        figures |= play_recordings(asked["bags"], {"calibration": asked["calibration"]})
    print(json.dumps(figures))


def ablate(rules: Iterable[Rule], bags: Iterable[str] = (), calibration: str = "bench") -> Figures:
    """Switch off rules one at a time.

    Args:
        rules: to be switched off.
        bags: recordings; the scenes that reach each rule without.
        calibration: of the finger of the recordings.

    Raises:
        FinforceError: a process fails.
    """
    rules, bags = list(rules), list(bags)
    names = [] if bags else list(dict.fromkeys(name for rule in rules for name in rule.scenes))
    with TemporaryDirectory(prefix="finforce_scenes_") as folder, progress_bar(len(rules) + 1, "rule", "ablation") as bar:
        bench = Bench(Plan())
        for name in names:
            (Path(folder) / name).write_bytes(pickle.dumps(build_scene(bench, name)))
        usual = run_child(None, Path(folder), names, bags, calibration)
        bar.update(1)
        rows = []
        for rule in rules:
            found = run_child(rule, Path(folder), () if bags else rule.scenes, bags, calibration)
            rows += [{"rule": rule.name, "scene": scene, **describe(usual[scene], figures)}
                     for scene, figures in found.items()]  # fmt: skip
            bar.update(1)
    table = pd.DataFrame(rows)
    best = table.loc[table.groupby("rule", sort=False)["moves"].idxmax()].drop(columns="moves")
    told = {rule.name: rule for rule in rules}
    best.insert(1, "stands on", [told[name].stands_on for name in best.rule])
    best.insert(2, "for", [told[name].purpose for name in best.rule])
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
