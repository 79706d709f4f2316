"""Bytes that pip installs for a project: its requirements followed through the metadata of this environment.

Knows of no project what it needs; what a requirement asks for and this environment lacks is named, not guessed.
"""

import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import Distribution, PackageNotFoundError, PathDistribution, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

_SHOWN = 5


@dataclass(frozen=True, kw_only=True)
class Project:
    """What a folder with a setup.py says of itself.

    Attributes:
        requires: requirements, with the extras that ask for them.
        extras: their names.
        size: of the files that are installed [bytes].
    """

    requires: tuple[str, ...]
    extras: tuple[str, ...]
    size: int


@dataclass(frozen=True, kw_only=True)
class Installed:
    """What an installation takes up.

    Attributes:
        packages: other projects that come with it.
        size: of all of them and the project itself [bytes].
        largest: name -> size of the largest of them [bytes].
        missing: those that are not installed here and are in no size.
    """

    packages: int
    size: int
    largest: dict[str, int]
    missing: tuple[str, ...]


def read_project(folder: Path) -> Project:
    """Returns requirements and size of a project as its own setup.py describes them.

    Raises:
        CalledProcessError: setup.py cannot be run.
    """
    with tempfile.TemporaryDirectory() as place:
        command = [sys.executable, "setup.py", "-q", "egg_info", "--egg-base", place]
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
        (found,) = Path(place).glob("*.egg-info")
        described = PathDistribution(found)
        listed = (found / "SOURCES.txt").read_text(encoding="utf-8").splitlines()
        requires = tuple(described.requires or ())
        extras = tuple(described.metadata.get_all("Provides-Extra") or ())
    # the list also has what a source archive would add to what is installed
    kept = [name for name in listed if not name.startswith(("/", "test", "setup.", "pyproject", "README"))]
    return Project(requires=requires, extras=extras, size=sum((folder / name).stat().st_size for name in kept))


def measure_installation(
    project: Project, extras: Sequence[str] = (), find: Callable[[str], Distribution] = distribution
) -> Installed:
    """Returns what a project takes up with all that it needs, and what that needs.

    Args:
        project: the project.
        extras: names of its extras that are asked for.
        find: gives the installed distribution of a name.
    """
    found: dict[str, int] = {}
    missing: list[str] = []
    done: set[tuple[str, str]] = set()
    waiting = [(text, extra) for extra in ("", *extras) for text in project.requires]
    while waiting:
        text, asked = waiting.pop()
        requirement = Requirement(text)
        if requirement.marker and not requirement.marker.evaluate({"extra": asked}):
            continue
        name = canonicalize_name(requirement.name)
        wanted = {(name, extra) for extra in ("", *requirement.extras)} - done
        done |= wanted
        try:
            package = find(name)
        except PackageNotFoundError:
            missing += [name] if wanted else []
            continue
        found[name] = _count_bytes(package)
        waiting += [(text, extra) for _, extra in wanted for text in package.requires or ()]
    return Installed(
        packages=len(found),
        size=project.size + sum(found.values()),
        largest=dict(sorted(found.items(), key=lambda item: -item[1])[:_SHOWN]),
        missing=tuple(sorted(missing)),
    )


def _count_bytes(package: Distribution) -> int:
    """Returns the size [bytes] of the files that are listed as a package's own, as far as they exist."""
    paths = (Path(str(package.locate_file(file))) for file in package.files or ())
    return sum(path.stat().st_size for path in paths if path.is_file())
