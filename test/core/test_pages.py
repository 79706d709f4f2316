"""Claims about README and docs: every command on a page can be typed, and every program on a page runs."""

import ast
import io
import re
import shlex
from argparse import Namespace
from contextlib import redirect_stderr, suppress
from functools import cache
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
import page_trials
import pytest
import yaml

from finforce.errors import MissingDependencyError
from finforce.ros.start import NODES
from finforce.systems.launch import options_from_words
from finforce.systems.processes import BenchOptions, ReplayOptions, RobotOptions, StackOptions
from finforce_eval.cli.launch import list_parts
from finforce_eval.cli.main import COMMANDS, build_parser, parse
from finforce_eval.cli.pipeline import pipeline_process
from finforce_eval.evaluation.keypoint_source import parse_source
from finforce_eval.evaluation.setup import parse_settings, read_contacts

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
LAUNCHED = {"bench": BenchOptions, "replay": ReplayOptions, "robot": RobotOptions}
LAUNCHED |= dict.fromkeys(("ros2_control", "moveit"), StackOptions)
OTHERS = {".", "cd", "colcon", "dask", "docker", "export", "git", "lerobot-train", "pip", "pytest", "rosdep", "source"}
OTHERS |= {"sudo"}
PROGRAMS = {"finforce", "make", "python", "ros2"} | OTHERS
_FENCE = re.compile(r"^((?: *<!-- .*? -->\n)?)( *)```(\w*)\n(.*?)^ *```$", re.S | re.M)
_INDENTED = re.compile(r"(?<=\n\n)(?: {4}\S.*\n)(?:(?: {4}.*)?\n)*", re.M)
_MARK = re.compile(r"<!-- (illustration|needs): (.*?) -->")


class Block(NamedTuple):
    """A block of a page: its language, what a comment before it says of it, and its lines."""

    page: str
    language: str
    mark: str
    wanted: str
    text: str

    def __str__(self):
        return f"{self.page}:{self.text.splitlines()[0][:40]}"


def blocks_of(path):
    text, name = path.read_text(encoding="utf-8"), path.name
    for comment, indent, language, inner in _FENCE.findall(text):
        mark, wanted = (_MARK.findall(comment) or [("", "")])[0]
        yield Block(name, language, mark, wanted, re.sub(rf"^{indent}", "", inner, flags=re.M))
    for inner in _INDENTED.findall(_FENCE.sub("", re.sub(r"^(#.*\n)", r"\1\n", text, flags=re.M))):
        if not re.match(r" {4}[-*] ", inner):
            yield Block(name, "", "", "", re.sub(r"^ {4}", "", inner, flags=re.M))


BLOCKS = [block for path in PAGES for block in blocks_of(path)]
HELPS = {name: build_parser(name).epilog for name in COMMANDS}
BLOCKS += [
    Block(f"finforce {name} --help", "", "", "", text.replace("\n  ", "\n")) for name, text in HELPS.items() if text
]
PYTHON = [block for block in BLOCKS if block.language == "python" and "iter_frames" not in block.text]  # test_door.py


def commands_of(block):
    """Every command of a block, as words; of what a page shows of an output or a formula, none."""
    for line in block.text.replace("\\\n", " ").splitlines():
        for part in re.sub(r"\s+#\s.*", "", line).split(" && "):
            if part.split()[:1] and part.split()[0] in PROGRAMS:
                yield tuple(part.split() if "[" in part else shlex.split(part))


COMMAND_BLOCKS = [block for block in BLOCKS if block.language in ("", "sh", "bash")]
COMMAND_LINES = sorted({words for block in COMMAND_BLOCKS for words in commands_of(block)})


def test_the_pages_have_what_is_checked_here():
    assert len(PYTHON) > 3 and len(COMMAND_LINES) > 60
    assert {words[0] for words in COMMAND_LINES} >= {"finforce", "make", "python", "ros2"}


def check_finforce(words):
    if any("[" in word for word in words):  # a synopsis
        known = build_parser(words[1])._option_string_actions
        assert {option for word in words for option in re.findall(r"--?[a-z][a-z-]*", word)} <= set(known)
        return
    if "--rig" in words:  # whose file is read at once
        known = build_parser(words[1])._option_string_actions
        assert "--rig" in known
        if known["--rig"].required:  # nothing can be parsed without
            assert {word for word in words if word.startswith("--")} <= set(known)
            return
        words = words[: words.index("--rig")] + words[words.index("--rig") + 2 :]
    with redirect_stderr(io.StringIO()) as said:
        try:
            options = parse(words[1:])
        except SystemExit as stop:
            assert stop.code == 0, said.getvalue()
            return
    check_texts(words[1], options)


def check_texts(command, options):
    """Check the options that argparse leaves as texts."""
    if command == "pipeline":
        pipeline_process(options.words)
    if command == "launch":
        list_parts(options.system, options.words)
    if command in ("evaluate", "annotate", "calibrate", "weigh", "replay", "view", "check", "extrinsics"):
        options = Namespace(**{"contact": [], "set": [], "solver": "default", "mesh": "default", **vars(options)})
        if not any("Z_MM" in contact for contact in options.contact):
            read_contacts(options)
        parse_settings(options.solver, options.mesh, options.set)
        parse_source(options)


def check_ros2(words):
    if words[1:3] == ["launch", "finforce"]:
        assert (ROOT / "launch" / words[3]).is_file()
        options_from_words(LAUNCHED[words[3].split(".")[0]], words[4:])
    elif words[1:3] == ["run", "finforce"]:
        assert words[3] in NODES or words[3] == "finforce"
        for file in (words[at + 1] for at, word in enumerate(words) if word == "--params-file"):
            assert (ROOT / file).is_file()
    else:
        assert words[1] in ("launch", "run", "service", "topic", "param", "bag", "action", "node")


def check_make(words):
    targets = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M))
    assert set(words[1:]) - {word for word in words if "=" in word} <= targets


def check_python(words):
    if words[1] == "-m":
        path = ROOT.joinpath(*words[2].split("."))
        assert path.with_suffix(".py").is_file() or (path / "__main__.py").is_file()
    elif words[1] != "-c":
        assert (ROOT / words[1]).is_file()


CHECKS = {"finforce": check_finforce, "ros2": check_ros2, "make": check_make, "python": check_python}


@pytest.mark.parametrize("words", [words for words in COMMAND_LINES if words[0] in CHECKS], ids=" ".join)
def test_a_command_on_a_page_can_be_typed(words):
    CHECKS[words[0]](words)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_a_command_in_the_text_is_one(path):
    named = set(re.findall(r"`finforce ([a-z][\w-]*)", path.read_text(encoding="utf-8")))
    assert named <= set(COMMANDS)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_a_detector_parameter_in_the_text_is_one(path):
    stated = re.findall(r'--detector (?:"(.+?)"|([a-z][\w.]*=[^\s`)]+))', path.read_text(encoding="utf-8"))
    for quoted, plain in stated:
        parse_source(Namespace(detector=[quoted or plain], jaws=None, jaw=None))


def as_example(code):
    """A program without its docstring and comments."""
    tree = ast.parse(code)
    if ast.get_docstring(tree):
        del tree.body[0]
    return ast.dump(tree)


@cache
def examples():
    return {as_example(path.read_text(encoding="utf-8")) for path in (ROOT / "examples").glob("*.py")}


@cache
def givens():
    """What programs on the pages take for given."""
    rng = np.random.default_rng(1)
    rgb, depth = rng.integers(0, 255, (480, 640, 3), dtype=np.uint8), np.full((480, 640), 150, np.uint16)
    times = np.arange(0.0, 8.0, 1 / 30)
    return {"images": [(1.0, rgb, depth)], "times": times, "forces": np.where(times > 2.0, 1.5, 0.0), "grams": [160.0]}


def import_what_is_ours(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module.startswith("finforce"):
            with suppress(MissingDependencyError):
                exec(f"from {node.module} import {', '.join(name.name for name in node.names)}", {})


@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.py")), ids=lambda path: path.name)
def test_an_example_imports_what_there_is(path):
    import_what_is_ours(ast.parse(path.read_text(encoding="utf-8")))


@pytest.mark.parametrize("block", PYTHON, ids=str)
def test_a_program_on_a_page_runs(block, tmp_path, monkeypatch):
    tree = compile(block.text, block.page, "exec", ast.PyCF_ONLY_AST)
    if block.mark == "illustration" or as_example(block.text) in examples():  # which tests of their own run
        return import_what_is_ours(tree)
    monkeypatch.chdir(tmp_path)
    wanted = {name: givens()[name] for name in block.wanted.split(", ") if name}
    exec(compile(tree, block.page, "exec"), wanted)


@pytest.mark.parametrize("block", [b for b in BLOCKS if b.language in ("yaml", "xml")], ids=str)
def test_a_file_on_a_page_is_well_formed(block):
    if block.language == "yaml":
        assert yaml.safe_load(block.text)
    else:
        ElementTree.fromstring(f'<robot xmlns:xacro="http://www.ros.org/wiki/xacro">{block.text}</robot>')


def test_every_command_on_a_page_is_run_or_says_what_it_needs():
    commands = [command for page in page_trials.PAGES for command in page_trials.list_commands(page)]
    needs = [page_trials.missing_for(command) for command in commands]
    assert needs.count("") > 40  # `make pages` runs these
    patterns = [re.compile(pattern) for pattern in page_trials.NEEDS]
    assert all(any(pattern.search(command) for command in commands) for pattern in patterns)  # no excuse is left over
    ours = [command for command, need in zip(commands, needs, strict=True) if not need]
    assert {command.split()[0] for command in ours} <= {"finforce", "python"}


def test_every_example_that_a_page_includes_is_there():
    for path in PAGES:
        for file, section in re.findall(r'^--8<-- "([^":]+):?(\w*)"$', path.read_text(encoding="utf-8"), re.M):
            text = (ROOT / file).read_text(encoding="utf-8")
            assert not section or f"--8<-- [start:{section}]" in text
