"""Claims about the pictures and the page of a report."""

import json
import re
import subprocess
import sys
from base64 import b64decode

import numpy as np
import pytest
from eval_fakes import (
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
    folder = tmp_path / "new" / "report"
    folder.mkdir(parents=True)
    (folder / "second_images.png").write_bytes(b"of the images")
    page = write_report(evaluation, folder, keypoint_names="abcd", about={"solver": "fake"})
    shown, files = shown_in(page), [folder / "unity.png"]
    assert list(shown) == ["second: Key points in the images", "Estimated against measured force"]
    assert list(shown.values()) == [b"of the images", files[0].read_bytes()]
    assert all(map(drawn_hues, files))
    assert '"solver": "fake"' in page.read_text()


def test_an_exact_estimate_still_draws_and_html_in_the_name_of_a_recording_stays_text(tmp_path):
    result, recording = evaluate("<img src=x onerror=alert(1)>", gain=1.0)
    page = write_report(score_results([result], [recording]), tmp_path, keypoint_names="abcd", about={})
    assert drawn_hues(tmp_path / "unity.png")
    assert "<img src=x" not in page.read_text() and "u003cimg src=x" in page.read_text()


def test_matplotlib_is_loaded_only_for_a_report():
    code = (
        "import sys; from finforce_eval.evaluation import forces; from finforce_eval.figures import report; "
        "assert report and forces and 'matplotlib' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
