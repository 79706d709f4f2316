"""What a first start would have to wait for, done ahead: everything that is compiled, and the equilibria of jaws."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from contextlib import suppress
from multiprocessing import get_context

from finforce.errors import MissingDependencyError

Task = tuple[Callable[..., None], tuple[str, ...]]


def list_tasks(jaws: Sequence[str], calibration: str) -> list[Task]:
    """Return what is to be done for jaws, by file or name; an empty calibration is none."""
    return [
        (compile_solver, ()),
        (compile_detector, ()),
        (compile_contact, ()),
        *((build_equilibria, (jaw, calibration)) for jaw in jaws),
    ]


def run_tasks(tasks: Sequence[Task]) -> Iterator[str]:
    """Do tasks in as many processes as there are processors; yield the name of each when it is done.

    Raises:
        FinforceError: a task ended in one.
    """
    workers = min(len(tasks), os.cpu_count() or 1)
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        running: dict[Future[None], str] = {pool.submit(work, *given): work.__name__ for work, given in tasks}
        try:
            for future in as_completed(running):
                future.result()
                yield running[future]
        finally:
            pool.shutdown(cancel_futures=True)


def compile_solver() -> None:
    """Compile the solver with a jaw that is taken to be linear, which needs no equilibria."""
    from finforce_ifea.estimator import JawEstimator
    from finforce_ifea.jaw.jaw import load_jaw
    from finforce_ifea.settings import EstimatorSettings

    for held in ("no", "yes"):
        JawEstimator(load_jaw("bench"), settings=EstimatorSettings(solver="linear", held=held)).warm_up()


def build_equilibria(jaw: str, calibration: str) -> None:
    """Build the stored equilibria of a jaw, and compile what they need.

    Raises:
        FinforceError: the jaw or the calibration cannot be used.
    """
    from finforce_ifea.estimator import JawEstimator
    from finforce_ifea.jaw.calibration import load_calibration
    from finforce_ifea.jaw.jaw import load_jaw

    JawEstimator(load_jaw(jaw), calibration=load_calibration(calibration) if calibration else None)


def compile_contact() -> None:
    """Compile the contact estimator with the object of the recording that comes with finforce."""
    from finforce_contact.estimator import ContactEstimator
    from finforce_contact.jaw_contact import JawContact
    from finforce_contact.mesh.object_mesh import load_object_mesh
    from finforce_eval.recordings.objects import find_mesh
    from finforce_eval.recordings.recording import DEMO, read_recording
    from finforce_ifea.jaw.jaw import load_jaw

    mesh = load_object_mesh(find_mesh(read_recording(DEMO)))
    JawContact(ContactEstimator(load_jaw("bench")), tolerance=1, max_age=1).set_object(mesh)


def compile_detector() -> None:
    """Compile the geometry of the key point detector, with the network of one finger and with that of any."""
    from finforce_keypoints.build import ANY_FINGER, BENCH, build_detector
    from finforce_keypoints.parameters import DetectorParameters, load_jaws

    for network in (BENCH, ANY_FINGER):
        parameters = DetectorParameters(model=str(network))
        with suppress(MissingDependencyError):  # without its library it is not used either
            build_detector(load_jaws(parameters), parameters).detector.warm_up()
