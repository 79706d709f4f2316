"""The subcommands `twin list` and `twin record`: options to a scenario, footage to a recording and a picture of it."""

from __future__ import annotations

import argparse
from dataclasses import fields
from pathlib import Path
from typing import Any

from finforce_eval.cli.options import parse_changes
from finforce_eval.errors import OptionError, RecordingError
from finforce_eval.figures.preview import Preview
from finforce_eval.recordings.twin_writer import RecordingForm, write_footage
from finforce_twin.footage import FINGER, build_footage, parse_size
from finforce_twin.scenes.scenarios import SCENARIOS, Scenario, build_scenario
from finforce_twin.scenes.script import write_script

PREVIEW = "preview.jpg"


def run_list(options: argparse.Namespace) -> None:
    """Print the scenes, with the numbers in which each differs from the default."""
    for name, scenario in SCENARIOS.items():
        duration = write_script(scenario).stamps[-1]
        print(f"{name:<22} {duration:5.1f} s  {', '.join(_deviations(scenario))}")


def _deviations(scenario: Scenario) -> list[str]:
    """Return what makes a scene, as NAME=VALUE."""
    plain = {entry.name: entry.default for entry in fields(Scenario)}
    values = {name: getattr(scenario, name) for name in plain if name != "name"}
    named = ("object", "camera", "light")
    changed = [name for name, value in values.items() if name in named or value != plain[name]]
    return [f"{name}={_short(values[name])}" for name in changed]


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value) or "none"


def run_record(options: argparse.Namespace) -> None:
    """Render a scene and write the recording, its mesh, its `case.json` and a preview.

    Raises:
        FinforceError: an option or the scene cannot be used, or the folder exists.
    """
    folder = Path(options.output)
    check_new(folder)
    scenario = scenario_from_options(options)
    camera = parse_size(options.size)
    if min(options.seed, options.finger) < 0:
        raise OptionError(f"--seed {options.seed} --finger {options.finger}: expected numbers from 0")
    if not 1 <= options.quality <= 95:
        raise OptionError(f"--quality {options.quality}: expected 1 to 95")
    if not options.farthest > 0.0:
        raise OptionError(f"--farthest {options.farthest:g}: expected a distance above 0 [m]")
    form = RecordingForm(
        compressed=not options.raw,
        quality=options.quality,
        farthest=options.farthest,
        storage=options.storage,
        depth_step=1e-3 * options.depth_step,
    )
    record_scene(scenario, options.seed, folder, camera=camera, form=form, finger=options.finger)
    size = sum(path.stat().st_size for path in folder.iterdir()) / 1e6
    print(f"Recording: {folder} ({size:.1f} MB), preview: {folder / PREVIEW}")
    print(f"Score it with: finforce evaluate {folder} --from images")


def check_new(folder: Path) -> None:
    """Refuse a folder that exists, or that cannot be made, before the work that would fill it.

    Raises:
        RecordingError: it is one of these.
    """
    try:
        folder.mkdir(parents=True)
        folder.rmdir()
    except FileExistsError as error:
        if folder.exists():
            raise RecordingError(f"{folder}: exists already; a recording is written to a new folder") from error
        raise _not_made(folder, error) from error
    except OSError as error:
        raise _not_made(folder, error) from error


def _not_made(folder: Path, error: OSError) -> RecordingError:
    return RecordingError(
        f"-o {folder}: cannot be made ({error.strerror}); expected a new folder where one may be written"
    )


def record_scene(
    scenario: Scenario, seed: int, folder: Path, *, camera: Any, form: RecordingForm, finger: int = FINGER
) -> None:
    """Render a scene of a finger into a new folder, under a progress bar."""
    from tqdm import tqdm

    footage = build_footage(scenario, seed, camera, finger=finger, depth_step=form.depth_step)
    preview = Preview(len(footage))
    case = {
        "scene": scenario.name,
        "seed": seed,
        "finger": finger,
        "light": scenario.light,
        "object": {"kind": scenario.object},
    }
    with tqdm(total=len(footage), unit="image", desc=scenario.name, disable=None, leave=False) as bar:

        def seen(frame: Any) -> None:
            preview.take(frame)
            bar.update()

        write_footage(footage, folder, form=form, case=case, seen=seen)
    preview.save(folder / PREVIEW)


def scenario_from_options(options: argparse.Namespace) -> Scenario:
    """Return the scene that options name, with what they change in it.

    Raises:
        OptionError: a change is no NAME=VALUE, or its value has another type.
        ScenarioError: there is no such scene, or a number is out of its bounds.
    """
    defaults = {entry.name: entry.default for entry in fields(Scenario) if entry.name != "name"}
    changes = parse_changes("--set", "number", options.set, defaults)
    for name in ("light", "object", "camera"):
        if getattr(options, name) is not None:
            changes[name] = getattr(options, name)
    return build_scenario(options.scene, **changes)
