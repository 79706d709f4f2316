"""Memory and start of a solver in a process of its own, with empty and with filled caches.

python -m lab.bench.process SOLVER MESH JAW
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

from finforce_eval.replay.processes import ProcessError

_REST_FRAMES, _PRESSED_FRAMES = 60, 140


@dataclass(frozen=True, kw_only=True)
class Start:
    """What a fresh process needs.

    Attributes:
        memory: resident after 200 images [MB].
        imports: until the estimator can be built [s].
        build: of the estimator, compiled code loaded and warmed up [s]; what it caches is there already.
        build_uncached: the same with an empty cache folder [s]; None where nothing is cached.
        cache: size of what it caches [MB].
    """

    memory: float
    imports: float
    build: float
    build_uncached: float | None
    cache: float


def measure_start(solver: str, mesh: str, jaw: str = "bench") -> Start:
    """Returns what a fresh process with one estimator needs.

    The user's cache folder is replaced by an empty one; where the first process leaves something there, a second one
    shows the start with it. Compiled loops come from the sources' own folder in both.

    Raises:
        ProcessError: The process failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        first = _probe(solver, mesh, jaw, folder)
        size = sum(file.stat().st_size for file in Path(folder).rglob("*") if file.is_file())
        second = _probe(solver, mesh, jaw, folder) if size else first
    return Start(
        memory=second["memory"],
        imports=second["imports"],
        build=second["build"],
        build_uncached=first["build"] if size else None,
        cache=1e-6 * size,
    )


def _probe(solver: str, mesh: str, jaw: str, cache: str) -> dict[str, float]:
    """Returns the figures of one fresh process."""
    command = [sys.executable, "-m", "lab.bench.process", solver, mesh, jaw]
    surroundings = {**os.environ, "XDG_CACHE_HOME": cache, "FINFORCE_CACHE": ""}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=surroundings)
    if done.returncode:
        raise ProcessError(f"the process with solver {solver} ended with {done.returncode}: {done.stderr[-300:]}")
    return json.loads(done.stdout.splitlines()[-1])


def main(solver: str, mesh: str, jaw: str) -> None:
    """Builds and runs an estimator and prints what that took as JSON."""
    begin = perf_counter()
    from finforce_eval.replay.processes import resident_bytes
    from finforce_ifea.estimator import JawEstimator
    from finforce_ifea.jaw.jaw import load_jaw
    from finforce_ifea.settings import EstimatorSettings

    ready = perf_counter()
    estimator = JawEstimator(load_jaw(jaw), settings=EstimatorSettings(solver=solver, mesh=mesh))
    estimator.warm_up()
    built = perf_counter()
    _press(estimator)
    print(json.dumps({"memory": 1e-6 * resident_bytes(), "imports": ready - begin, "build": built - ready}))


def _press(estimator: Any) -> None:
    """Gives an estimator a slow push against its middle; made here, as what makes better ones takes memory itself."""
    import numpy as np

    from finforce_ifea.observation import Contact, Observation

    jaw = estimator.jaw
    rest, height = jaw.keypoints, float(np.median(jaw.candidates[:, 2]))
    contact, low = Contact.fixed(jaw, height), float(rest[:, 2].min())
    # bent like a beam that is clamped below: 2 mm at the height of the contact
    share = np.maximum(rest[:, 2] - low, 0.0) / max(height - low, 1e-3)
    bent = np.outer(2e-3 * share**1.5, [-1.0, 0.0, 0.0])
    for index in range(_REST_FRAMES + _PRESSED_FRAMES):
        points = rest + max(0, index - _REST_FRAMES) / _PRESSED_FRAMES * bent
        estimator.update(Observation(stamp=index / 30.0, points=points, likelihood=np.ones(len(points))), contact)


if __name__ == "__main__":
    main(*sys.argv[1:])
