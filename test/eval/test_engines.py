"""Claims about the engine under evaluate, experiment and training data: its results do not depend on where."""

import json

import pytest
from eval_fakes import cut
from test_experiments import Counting

from finforce_eval.cli.main import main
from finforce_eval.recordings.recording import DEMO, read_recording
from finforce_eval.recordings.writer import write_recording
from finforce_eval.tasks import EngineOptions, Task
from lab.training.commands import TrainingError
from lab.training.pictures import make_all


def without_times(content):
    """Figures without what the machine's mood decides: times, and the last digits.

    A process that has compiled a kernel itself and one that has loaded it may differ in these.
    """
    if isinstance(content, dict):
        timed = [name for name in content if "_ms" in name or "delay" in name]  # a delay counts what a step took
        return {name: without_times(value) for name, value in content.items() if name not in timed}
    if isinstance(content, float):
        return float(f"{content:.9g}") if abs(content) > 1e-12 else 0.0
    return [without_times(value) for value in content] if isinstance(content, list) else content


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    folder, whole = tmp_path_factory.mktemp("bags"), read_recording(DEMO)
    begin = int(whole.jaws["left"].keypoints.stamps_ns[0])
    made = []
    for number in range(2):
        part = cut(whole, begin, begin + (3 + number) * 10**9)
        made.append(str(write_recording(part, folder / f"part{number}")))
    return made


def evaluate(bags, out, *words):
    assert main(["evaluate", *bags, "--contact", "fixed:42", "--calibration", "bench", "--json", str(out), *words]) == 0
    return without_times(json.loads(out.read_text()))


def test_evaluations_agree(bags, tmp_path, capsys):
    here = evaluate(bags, tmp_path / "here.json")
    there = evaluate(bags, tmp_path / "there.json", "--workers", "2")
    assert there == here
    assert list(here["cases"]) == ["part0", "part1"]


def test_an_experiment_goes_to_processes(tmp_path):
    figures = Counting().carry_out(tmp_path, EngineOptions(workers=2))
    assert figures.tables["Letters"]["letters"].sum() == 11


def write_number(number, path):
    if number == 3:
        raise TrainingError("three cannot be made")
    with open(path, "w", encoding="utf-8") as file:
        file.write(str(number))
    return {"numbers": 1}


def test_files_of_a_data_set_are_made_once_and_what_fails_is_named(tmp_path):
    def tasks(numbers):
        paths = {number: str(tmp_path / f"{number}.txt") for number in numbers}
        return [
            Task(name=str(number), key="k", work=write_number, given={"number": number, "path": path}, output=path)
            for number, path in paths.items()
        ]

    engine = EngineOptions()
    with pytest.raises(TrainingError, match="1 of 5 failed, 3 with: three cannot be made"):
        make_all(tasks(range(5)), engine, tmp_path, "file")
    before = (tmp_path / "2.txt").stat().st_mtime_ns
    (tmp_path / "1.txt").unlink()
    lines = make_all(tasks((0, 1, 2, 4)), engine, tmp_path, "file")
    assert sum(line["figures"]["numbers"] for line in lines) == 4
    assert (tmp_path / "2.txt").stat().st_mtime_ns == before and (tmp_path / "1.txt").exists()
