"""`finforce prepare`: do ahead of time what a first start would have to wait for."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, as_completed, wait
from contextlib import suppress
from multiprocessing import get_context
from typing import TYPE_CHECKING

import numpy as np

from finforce.errors import MissingDependencyError
from finforce.processors import ALL
from finforce_eval.cli.parser import CommandResult
from finforce_eval.tasks import progress_bar

if TYPE_CHECKING:
    from finforce_ifea.jaw.jaw import Jaw
    from finforce_ifea.reduced.build import Share


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    text = "jaw files or names of included jaws (bench)"
    parser.add_argument("jaws", nargs="*", default=["bench"], metavar="JAW", help=text)
    text = "calibration file, or name of an included one (materials of the jaw files)"
    parser.add_argument("--calibration", default="", metavar="FILE", help=text)


def run(options: argparse.Namespace) -> CommandResult:
    """Compile and build under a progress bar."""
    count = len(COMPILED) + len(options.jaws)
    prepared = []
    with progress_bar(count, "part", "preparing") as bar:
        for done in prepare(options.jaws, options.calibration):
            prepared.append(done)
            bar.update()
            bar.write(done)
    return CommandResult({"prepared": prepared})


_MOST = 8  # processes, each of some 300 MB


def prepare(jaws: Sequence[str], calibration: str) -> Iterator[str]:
    """Compile everything and build the equilibria of jaws in as many processes as there are processors, up to eight.

    Args:
        jaws: files or shipped names.
        calibration: of the fingers, a file or a shipped name; none when empty.

    Yields:
        What is done.

    Raises:
        FinforceError: a jaw or the calibration cannot be used.
    """
    found = [_load(jaw, calibration) for jaw in jaws]
    workers = min(len(ALL) or os.cpu_count() or 1, _MOST)
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        try:
            running = {pool.submit(work): done for work, done in COMPILED.items()}
            wait(running, return_when=FIRST_COMPLETED)  # else this process compiles what the first of these does
            for jaw in found:
                yield _store_equilibria(jaw, pool.map)
            for future in as_completed(running):
                future.result()
                yield running[future]
        finally:
            pool.shutdown(cancel_futures=True)


def compile_mechanics() -> None:
    """Compile the mechanics that an image is solved with, by a jaw at rest alone, which needs no equilibria."""
    from finforce_ifea.jaw.jaw import load_jaw
    from finforce_ifea.mechanics import build_mechanics
    from finforce_ifea.reduced.cache import reduce_mechanics
    from finforce_ifea.settings import EstimatorSettings

    jaw = load_jaw("bench")
    mechanics = reduce_mechanics(build_mechanics(jaw, EstimatorSettings()), jaw, linear=True)
    contact, model = mechanics.contact, mechanics.model
    state = np.array([0.0, 0.0, np.median(jaw.candidates[:, 2])])
    rest, keypoints = contact.begin(state[2]), model.attach(jaw.keypoints)
    step = contact.linearize(rest, state).correction
    model.positions(keypoints, contact.approach(rest, step, state))
    model.project(keypoints, rest, step[:, None])


def compile_tracking() -> None:
    """Compile what follows contact and force, by a jaw whose mechanics need neither equilibria nor those compiled."""
    from finforce_ifea.estimator import ForceEstimator
    from finforce_ifea.jaw.jaw import load_jaw
    from finforce_ifea.settings import EstimatorSettings

    for held in ("no", "yes"):
        ForceEstimator(load_jaw("bench"), settings=EstimatorSettings(solver="frame", held=held)).warm_up()


def _load(name: str, calibration: str) -> Jaw:
    """Return a jaw with its calibration, an empty one being none; raises FinforceError where one cannot be used."""
    from finforce_ifea.jaw.calibration import load_calibration
    from finforce_ifea.jaw.jaw import load_jaw
    from finforce_ifea.settings import EstimatorSettings

    jaw = load_jaw(name)
    if not calibration:
        return jaw
    found = load_calibration(calibration)
    found.expect_error(jaw, EstimatorSettings().solver)
    return found.apply(jaw)


def _store_equilibria(jaw: Jaw, share: Share) -> str:
    """Build the stored equilibria of a jaw; return what came of it."""
    from finforce_ifea.errors import ContactError
    from finforce_ifea.mechanics import build_mechanics, choose_full
    from finforce_ifea.reduced.cache import store_manifold
    from finforce_ifea.settings import EstimatorSettings

    try:
        store_manifold(build_mechanics(jaw, choose_full(EstimatorSettings())), jaw, share)
    except ContactError as error:
        return f"no equilibria of {jaw.name}, every step is slower: {error}"
    return f"equilibria of {jaw.name} stored"


def compile_contact() -> None:
    """Compile the contact estimator with the object of the recording that comes with finforce."""
    from finforce_contact.estimator import ContactEstimator
    from finforce_contact.loop import ContactLoop
    from finforce_contact.mesh.object_mesh import load_object_mesh
    from finforce_eval.recordings.objects import find_mesh
    from finforce_eval.recordings.recording import DEMO, read_recording
    from finforce_ifea.jaw.jaw import load_jaw

    mesh = load_object_mesh(find_mesh(read_recording(DEMO)))
    ContactLoop(ContactEstimator(load_jaw("bench"))).set_object(mesh)


def compile_detector() -> None:
    """Compile the geometry of the key point detector, with the network of one finger and with that of any."""
    from finforce_keypoints.build import ANY_FINGER, BENCH, build_detector
    from finforce_keypoints.parameters import DetectorParameters, load_jaws

    for network in (BENCH, ANY_FINGER):
        parameters = DetectorParameters(model=str(network))
        with suppress(MissingDependencyError):  # without its library it is not used either
            build_detector(load_jaws(parameters), parameters).warm_up()


# The longest first.
COMPILED = {
    compile_tracking: "tracking of contact and force compiled",
    compile_mechanics: "mechanics compiled",
    compile_detector: "detector compiled",
    compile_contact: "contact estimator compiled",
}
