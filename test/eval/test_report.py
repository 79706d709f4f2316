"""Claims about the pictures and the page of a report."""

import json
import re
import subprocess
import sys
from base64 import b64decode

import numpy as np
import pytest
from eval_fakes import FakeEstimator, FakeJaw, drawn_hues, evaluate_recording, make_recording

from finforce_contact.loop import GivenContact
from finforce_eval.evaluation.scoring import score_results
from finforce_eval.figures.report import write_overview

pytest.importorskip("matplotlib")


def evaluate(name, *, gain=1.1, phases=True, lost=()):
    recording = make_recording(name, phases=phases)
    forces = list(recording.jaws["left"].truth.force * gain)
    for index in lost:
        forces[index] = None
    jaw = FakeJaw(keypoints=np.zeros((4, 3)))
    return evaluate_recording(recording, jaw, GivenContact(None), FakeEstimator(forces)), recording


def shown_in(page):
    """The bytes of the picture that the page shows."""
    data = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', page.read_text())[1])
    return b64decode(data["pictures"][-1].partition(",")[2])


def test_the_page_shows_the_picture_of_all_cases(tmp_path):
    cases = [evaluate("first", phases=False), evaluate("second/left", lost=[0, 17])]
    results, recordings = zip(*cases, strict=True)
    evaluation = score_results(results, recordings)
    folder = tmp_path / "new" / "report"
    page = write_overview(evaluation, folder, about={"solver": "fake"})
    picture = folder / "errors.png"
    assert shown_in(page) == picture.read_bytes() and drawn_hues(picture)
    assert '"solver": "fake"' in page.read_text()


def test_an_exact_estimate_still_draws_and_html_in_the_name_of_a_recording_stays_text(tmp_path):
    result, recording = evaluate("<img src=x onerror=alert(1)>", gain=1.0)
    page = write_overview(score_results([result], [recording]), tmp_path, about={})
    assert drawn_hues(tmp_path / "errors.png")
    assert "<img src=x" not in page.read_text() and "u003cimg src=x" in page.read_text()


def test_matplotlib_is_loaded_only_for_a_report():
    code = (
        "import sys; from finforce_eval.evaluation import forces; from finforce_eval.figures import report; "
        "assert report and forces and 'matplotlib' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
