"""The notebook of the examples, from the finger's STL to its force, cell by cell."""

import json
import re
from pathlib import Path

import pytest
from matplotlib import pyplot

from finforce_eval.cli.main import main

ROOT = Path(__file__).parents[2]
NOTEBOOK = ROOT / "examples" / "own_finger.ipynb"


def finforce(words):
    """Run a command in this process, with a mesh whose equilibria take seconds."""
    return main([*words, "--mesh", "coarse"] if words[0] == "evaluate" else words)


def run_cells(path):
    """Run the cells of a notebook in this folder, `!finforce` in this process, and return their names."""
    names, cells = {"finforce": finforce}, json.loads(path.read_text(encoding="utf-8"))["cells"]
    for cell in cells:
        if cell["cell_type"] == "code":
            text = "".join(cell["source"]).replace("\\\n", " ")
            exec(re.sub(r"^!finforce (.*)$", r"assert finforce('\1'.split()) == 0", text, flags=re.M), names)
    return names


def test_notebook_goes_from_an_stl_to_a_force(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pyplot.switch_backend("agg")
    left = run_cells(NOTEBOOK)["left"]
    pressed = left[left.true_force_x < -1.0]
    assert len(pressed) > 5
    assert pressed.force_x.to_numpy() == pytest.approx(pressed.true_force_x.to_numpy(), rel=0.4)
    assert left[left.true_force_x > -0.01].force_x.abs().max() < 0.1
