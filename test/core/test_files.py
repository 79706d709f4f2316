"""Claims about files from anywhere: refused in one sentence, or read, within bounds of memory and time."""

import json
import os
import resource
import subprocess
import sys
from itertools import cycle
from pathlib import Path

import pytest
from eval_fakes import cut

from finforce.files import FileError, check_inside, check_plain, read_bytes, read_json, read_yaml

ROOT = Path(__file__).resolve().parents[2]


def laughs(levels, width=10):
    """References that stand for width^levels values."""
    lines = [f"a0: &a0 [{', '.join(['x'] * width)}]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * width)}]" for n in range(1, levels)]
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (laughs(9), "more than 50000 values"),
        ("material:\n  a: &a [x, y]\n" + "\n".join(f"  k{n}: &k{n} [*a, *a]" for n in range(30_000)), "more than"),
        ("a: &a [*a]", "refers to what it is itself part of"),
        ("a: &a {b: *a}", "refers to what it is itself part of"),
        ("[" * 1000 + "]" * 1000, "nested more than 50 deep"),
        ("a: " * 2, "not valid YAML"),
        ("{" * 60, "deep"),
        ("young_modulus: " + "9" * 5000, "5000 digits"),
        ("a: 0x" + "f" * 3000, "digits"),
        ("date: 2020-13-45", "not valid YAML"),
        ("1: 2\na: 3", "key '1' in the mapping from line 1 on is not text"),
        ("a: 1\na: 2", "'a' stands twice"),
        ("? [a, b]\n: 1", "not text"),
        ("a: !!python/object/apply:os.system [ls]", "not valid YAML"),
        ("a: [1, 2", "not valid YAML"),
        ("a: \x00", "not valid YAML"),
        ("<<: 3\na: 1", "not valid YAML"),
    ],
)
def test_yaml_that_would_do_harm_is_refused(text, words, tmp_path):
    path = tmp_path / "file.yaml"
    path.write_text(text)
    with pytest.raises(FileError, match=words):
        read_yaml(path)


def test_yaml_that_is_sound_is_read(tmp_path):
    path = tmp_path / "file.yaml"
    path.write_text("base: &b {x: 1, y: 2.5}\nother:\n  <<: *b\n  z: [1, '1', true, null, 1e300]\nlist: [*b, *b]\n")
    base = {"x": 1, "y": 2.5}
    other = {**base, "z": [1, "1", True, None, "1e300"]}
    assert read_yaml(path) == {"base": base, "other": other, "list": [base, base]}
    path.write_text("\ufeffa: 1\n", encoding="utf-8")
    assert read_yaml(path) == {"a": 1}
    path.write_text("1: a\n")
    assert read_yaml(path, text_keys=False) == {1: "a"}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 100_000, "not valid JSON"),
        ("{", "not valid JSON"),
        ("1" * 10_000, "not valid JSON"),
        ("", "not valid JSON"),
    ],
)
def test_json_that_would_do_harm_is_refused(text, words, tmp_path):
    path = tmp_path / "file.json"
    path.write_text(text)
    with pytest.raises(FileError, match=words):
        read_json(path)


def test_what_is_no_plain_file_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path, words in (
        (tmp_path / "pipe", "not a plain file"),
        (tmp_path, "plain file|directory"),
        ("/dev/zero", "not a plain file"),
        (tmp_path / "nothing", "No such file"),
        (str(tmp_path / "null\0byte"), "cannot be read"),
    ):
        with pytest.raises(FileError, match=words):
            read_bytes(path)


def test_a_link_to_itself_is_refused(tmp_path):
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(FileError, match="loop cannot be read|Too many levels|not a plain file"):
        check_plain(check_inside(tmp_path / "loop", tmp_path))


def test_large_files_and_other_texts_are_refused(tmp_path):
    with (tmp_path / "large").open("wb") as file:
        file.truncate(1 << 32)
    with pytest.raises(FileError, match="more than 16384 KiB"):
        read_bytes(tmp_path / "large")
    (tmp_path / "binary").write_bytes(b"a: \xff\xfe")
    with pytest.raises(FileError, match="not UTF-8 text: invalid start byte at byte 3"):
        read_yaml(tmp_path / "binary")


COMMANDS = {
    "jaw": ["evaluate", "BAG", "--jaw", "FILE"],
    "calibration": ["evaluate", "BAG", "--calibration", "FILE"],
    "model": ["evaluate", "BAG", "--from", "images", "--detector", "model=FOLDER"],
}
BOMBS = {
    "references": "name: a\nmaterial:\n" + "\n".join("  " + line for line in laughs(9).splitlines()),
    "lists": "name: a\nmaterial: " + "[" * 1000,
    "digits": "young_modulus: " + "9" * 5000 + "\n",
    "month": "young_modulus: 2020-13-01\n",
    "keys": "young_modulus: 1.0e+6\n3: 4\nnull: 5\n",
    "huge": "young_modulus: 1.0e+300\npoisson_ratio: .nan\n",
    "values": "young_modulus: [" + "1, " * 60_000 + "]\n",
}


def bounded():
    """A tenth of what a bomb would take."""
    resource.setrlimit(resource.RLIMIT_DATA, (1 << 30, 1 << 30))


SAY_ALL = """
import contextlib, io, json, sys
from finforce_eval.cli.main import main

said = {}
for name, words in json.loads(sys.argv[1]).items():
    with contextlib.redirect_stderr(io.StringIO()) as errors:
        said[name] = [main(words), errors.getvalue()]
print(json.dumps(said))
"""


def test_commands_say_what_is_wrong_in_one_line(tmp_path):
    from finforce_eval.recordings.recording import DEMO, read_recording
    from finforce_eval.recordings.writer import write_recording

    recording, orders, chosen = read_recording(DEMO), {}, cycle(COMMANDS.items())
    begin = int(recording.jaw("left").keypoints.stamps_ns[0])
    bag = write_recording(cut(recording, begin, begin + 10**9), tmp_path / "bag")
    for name, bomb in BOMBS.items():
        file = tmp_path / name / "pytorch_config.yaml"
        file.parent.mkdir()
        file.write_text(bomb)
        places = {"FILE": str(file), "BAG": str(bag)}
        # what no file may hold is refused before a command looks at it: there one command tells as much as all
        for command, words in [next(chosen)] if name in ("lists", "digits", "values") else COMMANDS.items():
            orders[f"{command}, {name}"] = [places.get(w, w.replace("FOLDER", str(file.parent))) for w in words]
    process = subprocess.run(
        [sys.executable, "-c", SAY_ALL, json.dumps(orders)],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=ROOT,
        preexec_fn=bounded,
    )
    assert process.returncode == 0, process.stderr
    for status, text in json.loads(process.stdout.splitlines()[-1]).values():
        assert status == 2, text
        assert len(text.strip().splitlines()) == 1, text
        assert "Traceback" not in text
