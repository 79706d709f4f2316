"""What `finforce prepare` leaves for a start to do."""

import subprocess
import sys
from pathlib import Path
from textwrap import dedent

import pytest
from eval_fakes import cut

from finforce_eval.cli import prepare as preparation
from finforce_eval.cli.main import main
from finforce_eval.recordings.objects import find_mesh
from finforce_eval.recordings.recording import DEMO, read_recording
from finforce_eval.recordings.writer import write_recording
from finforce_ifea.errors import ContactError
from finforce_ifea.jaw import calibration
from finforce_ifea.jaw.jaw import load_jaw

GRASP = 7  # [s], of which the object touches from 3.4 s on
START = dedent("""
    import sys

    from numba.core import event

    compiled = []

    class Listener(event.Listener):
        def on_start(self, event):
            compiled.append(event.data["dispatcher"].__name__)

        def on_end(self, event):
            pass

    event.register("numba:compile", Listener())
    from finforce_eval.cli import prepare as preparation
    from finforce_eval.cli.main import main

    preparation.compile_mechanics()
    preparation.compile_tracking()
    preparation.compile_contact()
    preparation.compile_detector()
    words = ["--contact", "estimate", "--calibration", "bench", "--set", "held=yes"]
    assert main(["evaluate", *sys.argv[1:], *words]) == 0
    print(compiled)
""")


def test_after_it_a_start_and_a_first_grasp_that_is_held_compile_nothing(tmp_path, capsys):
    assert main(["prepare", "--calibration", "bench"]) == 0
    said = capsys.readouterr().out
    parts = ("tracking", "mechanics", "equilibria of bench", "contact estimator", "detector")
    assert all(part in said for part in parts)
    whole = read_recording(DEMO)
    begin = int(whole.jaw("left").keypoints.stamps_ns[0])
    grasp = write_recording(cut(whole, begin, begin + GRASP * 10**9), tmp_path / "grasp")
    command = [sys.executable, "-c", START, str(grasp), "--object", str(find_mesh(whole))]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_every_jaw_that_is_named_has_its_equilibria_built(monkeypatch):
    built = []
    monkeypatch.setattr(preparation, "COMPILED", {})
    monkeypatch.setattr(preparation, "_store_equilibria", lambda jaw, share: built.append(jaw) or jaw.name)
    assert list(preparation.prepare(["bench", "umi"], "")) == ["bench", "umi"]
    assert [jaw.name for jaw in built] == ["bench", "umi"]
    list(preparation.prepare(["bench"], "bench"))
    assert built[0].material.young_modulus != built[2].material.young_modulus


def test_a_jaw_that_cannot_be_pressed_is_said(monkeypatch, tmp_path):
    def refuse(function, items):
        raise ContactError("it gives way")

    monkeypatch.setenv("FINFORCE_CACHE", str(tmp_path))
    said = preparation._store_equilibria(load_jaw("bench"), refuse)
    assert said == "no equilibria of bench, every step is slower: it gives way"


def test_a_calibration_that_a_node_would_refuse_is_refused(tmp_path, capsys):
    text = (
        (Path(calibration.__file__).parent / "calibrations" / "bench.yaml")
        .read_text()
        .replace("solver: solid", "solver: paper")
    )
    assert "solver: paper" in text
    (tmp_path / "paper.yaml").write_text(text)
    assert main(["prepare", "bench", "--calibration", str(tmp_path / "paper.yaml")]) == 2
    assert "paper" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["nowhere"], ["bench", "--calibration", "nowhere"]])
def test_an_unknown_name_is_one_line(words, capsys):
    assert main(["prepare", *words]) == 2
    error = capsys.readouterr().err
    assert "nowhere" in error and error.count("\n") == 1
