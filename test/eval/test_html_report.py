"""Claims about the HTML report: in a real browser plots are drawn, zoom, and say what was found."""

import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from eval_fakes import FakeEstimator, FakeJaw, cut, evaluate_recording, make_recording

from finforce_contact.loop import GivenContact
from finforce_eval.cli.main import main
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.batch import read_evaluations
from finforce_eval.evaluation.scoring import score_results, true_range
from finforce_eval.figures.report import PageHead, describe_series, write_html, write_page
from finforce_eval.recordings.writer import write_recording
from finforce_eval.table import ForceSeries, read_table, write_table

BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
INKED = """(() => {
  const { canvas } = plots[0], { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  return data.filter((value, index) => index % 4 === 3 && value > 0).length / (data.length / 4);
})()"""
EVIL = '</script><img src=x onerror="document.title=1"><b>&amp;'


@pytest.fixture(scope="module")
def browser():
    sync_api = pytest.importorskip("playwright.sync_api", reason="a page is looked at with playwright")
    found = next((path for path in map(shutil.which, BROWSERS) if path), None)
    with sync_api.sync_playwright() as tool:
        try:
            started = tool.chromium.launch(executable_path=found, args=["--no-sandbox"])
        except sync_api.Error as error:
            pytest.skip(f"no browser: {str(error).splitlines()[0]}; install chromium-headless-shell")
        yield started
        started.close()


def look_at(browser, path):
    """The page, what it asked for, and what its scripts complained of."""
    page, asked, said = browser.new_page(viewport={"width": 1100, "height": 900}), [], []
    page.on("request", lambda request: asked.append(request.url))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("console", lambda message: said.append(message.text))
    page.goto(path.as_uri())
    page.wait_for_selector("html[data-drawn]")
    return page, asked, said


def make_course(name="pressed", count=600, truth=True):
    stamps = 10**18 + np.arange(count) * 33_333_333
    force = np.column_stack([-3.0 + 2.0 * np.cos(np.arange(count) / 40), np.zeros(count), np.full(count, 0.5)])
    force[:20] = np.nan
    return ForceSeries.build(
        name,
        "left",
        stamps,
        force=force,
        magnitude_stddev=np.full(count, 0.1),
        status=np.where(np.isnan(force[:, 0]), "waiting", "ok"),
        scored=np.arange(count) % 200 > 150,
        direction=np.where(np.arange(count) > 300, "unload", "load"),
        true_force=np.nan_to_num(force) * 1.1 if truth else None,
    )


def window(canvas):
    return tuple(float(canvas.get_attribute(name)) for name in ("data-from", "data-to"))


def test_plots_zoom_move_and_say_what_was_found(browser, tmp_path):
    page_file = write_html([make_course(), make_course("other", truth=False)], tmp_path / "r.html", PageHead("T", {}))
    page, asked, said = look_at(browser, page_file)
    assert page.title() == "T" and page.locator("canvas").count() == 2
    canvas = page.locator("#case0 canvas")
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    left, width = 52, box["width"] - 62

    def at(share):
        return box["x"] + left + share * width, box["y"] + 100

    page.mouse.move(*at(0.25))
    page.mouse.down()
    page.mouse.move(*at(0.75))
    page.mouse.up()
    span = 599 * 0.033333333
    assert window(canvas) == pytest.approx((0.25 * span, 0.75 * span), rel=0.02)
    page.mouse.move(*at(0.5))
    page.mouse.wheel(0, -400)
    page.wait_for_function("plots[0].view[1] - plots[0].view[0] < 6")
    begin, end = window(canvas)
    assert 0.5 * (begin + end) == pytest.approx(0.5 * span, rel=0.02)
    index = int(round(0.5 * span / 0.033333333))
    words = page.locator("#case0 .said").inner_text()
    expected = np.linalg.norm(make_course().force, axis=1)
    assert any(f"{expected[index + k]:.3f} N ± 0.200" in words for k in (-1, 0, 1)), words
    assert "true" in words and words.endswith("ok")
    page.mouse.dblclick(*at(0.5))
    assert window(canvas) == pytest.approx((0.0, span), rel=1e-3)
    drawn = page.evaluate(INKED)
    assert 0.02 < drawn < 0.9  # something, not everything
    assert asked == [page_file.as_uri()] and said == []
    page.close()


def test_numbers_arrive_as_they_are(browser, tmp_path):
    course = make_course(count=7)
    page, *_ = look_at(browser, write_html([course], tmp_path / "r.html", PageHead("T", {"jaw": "bench"})))
    found = np.array([np.nan if v is None else v for v in page.evaluate("Array.from(plots[0].x)")], dtype=float)
    assert np.allclose(found, course.force[:, 0].astype(np.float32), equal_nan=True)
    phases = np.where(course.scored, np.where(course.column("direction") == "unload", 2, 1), 0)
    assert page.evaluate("Array.from(plots[0].phase)") == phases.tolist()
    assert "bench" in page.locator("#about").inner_text()
    page.close()


def test_names_are_words_never_markup(browser, tmp_path):
    courses = [make_course(EVIL).with_columns(status=np.full(600, EVIL))]
    page, asked, said = look_at(browser, write_html(courses, tmp_path / "r.html", PageHead(EVIL, {EVIL: EVIL})))
    assert page.title() == EVIL and page.locator("img").count() == 0
    assert page.locator("#table tbody a").inner_text() == EVIL
    assert len(asked) == 1 and said == []
    page.close()


def test_a_click_on_a_head_sorts(browser, tmp_path):
    rows = [["b", "10"], ["a", "9"], ["c", "-"]]
    courses = [make_course(name) for name in "bac"]
    page, *_ = look_at(
        browser, write_html(courses, tmp_path / "r.html", PageHead("T", {}), columns=["case", "n"], rows=rows)
    )

    def names():
        return page.locator("#table tbody td:first-child").all_inner_texts()

    page.locator("th").nth(0).click()
    assert names() == ["a", "b", "c"]
    page.locator("th").nth(0).click()
    assert names() == ["c", "b", "a"]
    page.close()


def evaluated(name="pressed"):
    recording = make_recording(name)
    forces = recording.jaws["left"].truth.force * 1.1
    jaw, source = FakeJaw(), GivenContact(None)
    jaw = replace(jaw, keypoints=recording.jaws["left"].keypoints.points[0])
    return recording, evaluate_recording(recording, jaw, source, FakeEstimator(forces))


def test_the_page_of_an_evaluation_has_its_scores(browser, tmp_path):
    recording, result = evaluated()
    evaluation = score_results([result], [recording])
    page, asked, said = look_at(browser, write_page(evaluation, tmp_path / "r.html", PageHead("T", {})))
    assert page.locator("#table tbody tr").count() == 2
    assert f"{evaluation.total.all.bias_N:.2f}" in page.locator("#table tbody").inner_text()
    assert said == [] and len(asked) == 1
    page.close()


def test_the_headline_says_how_far_off_and_leaves_the_tare_out():
    course = make_course()
    words, error = describe_series([course]), np.sqrt(np.mean(course.error[course.counted] ** 2))
    assert words.startswith(f"{error:.3f} N RMSE") and words.endswith(
        "; 0 of 580 images after the tare without an answer"
    )
    course.table.loc[:2, "status"] = "diverged"
    assert "; 3 of 583 images" in describe_series([course])
    assert "RMSE" not in describe_series([make_course(truth=False)])


def keep(path, recording, result):
    write_table(path, [result], {"about": {"jaw": "x"}, "true_range_N": true_range(recording)})


def test_a_table_comes_back_as_it_was_written(tmp_path):
    recording, result = evaluated()
    keep(tmp_path / "pressed.parquet", recording, result)
    (again,), about = read_table(tmp_path / "pressed.parquet")
    assert about["about"] == {"jaw": "x"} and again.name == result.name and again.side == "left"
    for name in ("force", "true_force", "used", "status", "stamp", "scored", "contact_source"):
        assert np.array_equal(again.column(name), result.column(name), equal_nan=name.endswith("force")), name
    write_table(tmp_path / "bare.parquet", [result], {"jaw": "x"})
    with pytest.raises(RecordingError, match="says nothing of its run"):
        read_evaluations([tmp_path / "bare.parquet"])
    evaluation, _ = read_evaluations([tmp_path / "pressed.parquet"])
    assert evaluation.total == score_results([result], [recording]).total


def test_pandas_reads_a_table_by_the_names_of_its_columns(tmp_path):
    recording, result = evaluated()
    keep(tmp_path / "pressed.parquet", recording, result)
    table = pd.read_parquet(tmp_path / "pressed.parquet")
    assert len(table) == len(result) and {"case", "side", "stamp", "force_x", "true_force_z", "status"} <= set(table)
    assert np.array_equal(table["force_x"], result.force[:, 0], equal_nan=True)
    units = {field.name: field.metadata[b"unit"] for field in pq.read_schema(tmp_path / "pressed.parquet")}
    assert units["force_x"] == b"N" and units["torque_y"] == b"N m" and units["stamp"] == b"ns"


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b'{"a": 1}', b"PAR1" + bytes(40) + b"PAR1"])
def test_a_file_that_is_none_of_ours_is_refused(content, tmp_path):
    (tmp_path / "odd.parquet").write_bytes(content)
    with pytest.raises(RecordingError, match=r"odd\.parquet"):
        read_table(tmp_path / "odd.parquet")


def test_report_takes_annotated_recordings_and_kept_evaluations(tmp_path, capsys, browser):
    recording, result = evaluated()
    kept = tmp_path / "kept"
    kept.mkdir()
    keep(kept / "pressed.parquet", recording, result)
    page_file = tmp_path / "kept.html"
    assert main(["report", str(kept), "-o", str(page_file), "--title", "Mine"]) == 0
    page, *_ = look_at(browser, page_file)
    assert page.title() == "Mine" and page.locator("canvas").count() == 1
    page.close()
    bare = tmp_path / "video" / "forces.parquet"  # as `live` and `annotate` write it
    bare.parent.mkdir()
    right = ForceSeries(result.table.assign(side="right"))
    write_table(bare, [result, right], {"rig": "rig.yaml"})
    for source, plots in ((bare, 2), (bare.parent, 2), (kept / "pressed.parquet", 1)):
        assert main(["report", str(source), "-o", str(tmp_path / "table.html")]) == 0
        assert f"{plots} plots" in capsys.readouterr().out
    bag = write_recording(recording, tmp_path / "bag")
    assert main(["report", str(bag), "-o", str(tmp_path / "x.html")]) == 2
    assert "no forces" in capsys.readouterr().err
    assert main(["report", str(bag), "-o", str(tmp_path / "x.txt")]) == 2
    assert "ends in .html" in capsys.readouterr().err


def test_forces_of_an_annotated_recording_are_read_as_they_were_written(tmp_path):
    from finforce_eval.cli.report import read_forces
    from finforce_eval.recordings.recording import DEMO, read_recording

    whole = read_recording(DEMO)
    begin = int(whole.jaws["left"].keypoints.stamps_ns[0])
    bag = write_recording(cut(whole, begin, begin + 8 * 10**9), tmp_path / "short")
    out = tmp_path / "out"
    assert main(["annotate", str(bag), "--out", str(out), "--contact", "fixed:42", "--calibration", "bench"]) == 0
    (course,) = read_forces(out / "short")
    answered = np.isfinite(course.force).all(axis=1)
    assert 0.3 < answered.mean() < 1.0 and course.true_force is not None
    assert set(course.column("status")[answered]) <= {"ok", "unloaded"} and "waiting" in set(course.column("status"))
    error = np.linalg.norm(course.force - course.true_force, axis=1)[answered]
    assert np.nanmax(error) < 0.5
    assert np.isfinite(course.column("magnitude_stddev")[answered & (np.linalg.norm(course.force, axis=1) > 0)]).all()
