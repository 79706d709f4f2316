"""Claims about the pictures and the page of a report."""

import re
import subprocess
import sys

import numpy as np
import pytest
from eval_fakes import BOX, BOX_TRIANGLES, FakeEstimator, FakeJaw, drawn_hues, evaluate_recording, make_recording

from finforce_contact.loop import GivenContact
from finforce_eval.evaluation.scoring import score_results
from finforce_eval.figures.report import write_report

pytest.importorskip("matplotlib")


def evaluate(name, *, gain=1.1, phases=True, lost=()):
    recording = make_recording(name, phases=phases)
    forces = list(recording.jaws["left"].truth.force * gain)
    for index in lost:
        forces[index] = None
    jaw = FakeJaw(keypoints=np.zeros((4, 3)))
    return evaluate_recording(recording, jaw, GivenContact(None), FakeEstimator(forces)), recording


def test_report_shows_every_picture_it_names_and_names_every_picture(tmp_path):
    cases = [evaluate("first", phases=False), evaluate("second/left", lost=[0, 17])]
    results, recordings = zip(*cases, strict=True)
    evaluation = score_results(results, recordings)
    page = write_report(evaluation, tmp_path / "new" / "report", keypoint_names="abcd", about={"solver": "fake"})
    named = re.findall(r"!\[.*?\]\((.*?)\)", page.read_text())
    assert sorted(named) == sorted(path.name for path in page.parent.glob("*.png"))
    assert len(named) == 1 + 2 * 4
    assert all(drawn_hues(page.parent / name) for name in named)
    assert "- solver: fake" in page.read_text()


def test_exact_estimate_still_draws_and_html_in_the_name_of_a_recording_stays_text(tmp_path):
    result, recording = evaluate("<img src=x onerror=alert(1)>", gain=1.0)
    page = write_report(score_results([result], [recording]), tmp_path, keypoint_names="abcd", about={})
    assert "0.000" in page.read_text() or "0.00 " in page.read_text()
    assert drawn_hues(next(tmp_path.glob("*force*.png")))
    assert "&lt;img" in page.read_text() and "<" not in page.read_text()


def test_outline_of_a_box_from_the_side_is_its_rectangle():
    from finforce_eval.figures.figures import outline_edges

    edges = outline_edges(BOX, BOX_TRIANGLES)
    assert (BOX[edges][:, :, 1] == 0.01).all()
    lengths = np.linalg.norm(BOX[edges[:, 0]] - BOX[edges[:, 1]], axis=1)
    assert sorted(lengths.round(6).tolist()) == [0.028, 0.028, 0.08, 0.08]


def test_matplotlib_is_loaded_only_for_a_report():
    code = (
        "import sys; from finforce_eval.evaluation import forces; from finforce_eval.figures import report; "
        "assert report and forces and 'matplotlib' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
