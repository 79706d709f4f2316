"""Claims about the pictures and the page of a report."""

import json
import re
import subprocess
import sys
from base64 import b64decode

import numpy as np
import pytest
from eval_fakes import (
    BOX,
    BOX_TRIANGLES,
    FakeEstimator,
    FakeJaw,
    drawn_hues,
    evaluate_recording,
    make_recording,
    write_report,
)

from finforce_contact.loop import GivenContact
from finforce_eval.evaluation.scoring import score_results

pytest.importorskip("matplotlib")


def evaluate(name, *, gain=1.1, phases=True, lost=()):
    recording = make_recording(name, phases=phases)
    forces = list(recording.jaws["left"].truth.force * gain)
    for index in lost:
        forces[index] = None
    jaw = FakeJaw(keypoints=np.zeros((4, 3)))
    return evaluate_recording(recording, jaw, GivenContact(None), FakeEstimator(forces)), recording


def shown_in(page):
    """What the page shows: captions of its pictures and the bytes of each."""
    data = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', page.read_text())[1])
    return {caption: b64decode(source.partition(",")[2]) for caption, source in data["pictures"]}


def test_the_page_shows_every_picture_that_was_drawn(tmp_path):
    cases = [evaluate("first", phases=False), evaluate("second/left", lost=[0, 17])]
    results, recordings = zip(*cases, strict=True)
    evaluation = score_results(results, recordings)
    page = write_report(evaluation, tmp_path / "new" / "report", keypoint_names="abcd", about={"solver": "fake"})
    shown, files = shown_in(page), list(page.parent.glob("*.png"))
    assert sorted(shown.values()) == sorted(file.read_bytes() for file in files) and len(files) == 1 + 2
    assert next(iter(shown)) == "first: The jaw at the largest force"
    assert all(map(drawn_hues, files))
    assert '"solver": "fake"' in page.read_text()


def test_an_exact_estimate_still_draws_and_html_in_the_name_of_a_recording_stays_text(tmp_path):
    result, recording = evaluate("<img src=x onerror=alert(1)>", gain=1.0)
    page = write_report(score_results([result], [recording]), tmp_path, keypoint_names="abcd", about={})
    assert drawn_hues(next(tmp_path.glob("*jaw*.png")))
    assert "<img src=x" not in page.read_text() and "u003cimg src=x" in page.read_text()


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
