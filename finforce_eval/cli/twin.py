"""The subcommands `twin list` and `twin record`: options to a scenario, footage to a recording and a picture of it."""

from __future__ import annotations

import argparse
from dataclasses import fields
from pathlib import Path
from typing import Any

from finforce_eval.cli.parser import Parser, whole_number
from finforce_eval.errors import OptionError, RecordingError
from finforce_eval.evaluation.results import parse_changes
from finforce_eval.recordings.twin_writer import PREVIEW, RecordingForm, record_scene
from finforce_sim.footage import parse_size
from finforce_sim.scenarios import SCENARIOS, Scenario, build_scenario, write_script


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True, parser_class=Parser)
    listing = actions.add_parser("list", help="name the scenes")
    listing.set_defaults(run=run_list)
    record = actions.add_parser("record", help="render a scene and write it", description="render a scene and write it")
    record.add_argument("scene", metavar="SCENE", help="a name that `finforce twin list` prints")
    record.add_argument("-o", "--output", required=True, metavar="BAG", help="recording to be written, a new folder")
    record.add_argument("--seed", type=whole_number(0, 2**32), default=0, help="of textures, light and noise (0)")
    finger = "seed of the jaws' material; calibration twin is of finger 0 (0)"
    steps = "of the depth in mm: 1 as the ROS driver gives it, 0.1 as the camera itself does (1)"
    record.add_argument("--depth-step", type=float, default=1.0, choices=(1.0, 0.1), help=steps)
    record.add_argument("--finger", type=whole_number(0, 2**32), default=0, metavar="SEED", help=finger)
    record.add_argument("--light", metavar="WORD", help="bright, dim or any; without it that of the scene")
    record.add_argument("--object", metavar="NAME", help="shape by name, or mesh file; without it that of the scene")
    record.add_argument("--jaw", metavar="NAME", help="shipped jaw or jaw file; without it that of the scene, bench")
    text = "two jaws on the wrist or from beyond the tips, or one jaw on the bench"
    record.add_argument("--camera", choices=("robot", "front", "bench"), help=text)
    record.add_argument("--lens", default="d405", choices=("d405", "webcam", "fisheye"), help="of the camera (d405)")
    record.add_argument("--size", default="640x480", metavar="WxH", help="of the images (640x480)")
    text = "change a number of the scene, may be repeated; an unknown NAME lists them"
    record.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help=text)
    kind = record.add_mutually_exclusive_group()
    kind.add_argument("--compressed", action="store_true", help="jpeg colour and png depth (as it is without --raw)")
    kind.add_argument("--raw", action="store_true", help="plain images, 46 MB a second")
    record.add_argument("--quality", type=int, default=90, metavar="N", help="of the jpegs, 1 to 95 (90)")
    text = "leave depth beyond so many metres away, which makes a recording smaller"
    record.add_argument("--farthest", type=float, default=float("inf"), metavar="M", help=text)
    record.add_argument("--storage", default="mcap", choices=("mcap", "sqlite3"), help="format of the recording")
    record.set_defaults(run=run_record)


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
    camera = parse_size(options.size, options.lens)
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


def scenario_from_options(options: argparse.Namespace) -> Scenario:
    """Return the scene that options name, with what they change in it.

    Raises:
        OptionError: a change is no NAME=VALUE, or its value has another type.
        ScenarioError: there is no such scene, or a number is out of its bounds.
    """
    defaults = {entry.name: entry.default for entry in fields(Scenario) if entry.name != "name"}
    changes = parse_changes("--set", "number", options.set, defaults)
    for name in ("light", "object", "camera", "jaw"):
        if getattr(options, name) is not None:
            changes[name] = getattr(options, name)
    return build_scenario(options.scene, **changes)
