"""Claims about the demo: its recording, and the few figures with which it ends."""

import json
from argparse import Namespace
from base64 import b64decode
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest
from eval_fakes import FakeEstimator, FakeJaw, evaluate_recording
from rgbd_fakes import FakeDetector, FakeGripper, make_fake_recording

from finforce_contact.loop import GivenContact
from finforce_eval.cli import demo, replay
from finforce_eval.cli.twin import write_simulated_recording
from finforce_eval.errors import RecordingError
from finforce_eval.evaluation.keypoint_source import KeypointSource, detect_keypoints
from finforce_eval.evaluation.scoring import score_grasp, score_results
from finforce_eval.recordings.images import ALONE
from finforce_eval.recordings.recording import read_recording
from finforce_eval.replay.replay import Replay, _choose_keypoints
from finforce_ifea.jaw.jaw import load_jaw


@pytest.fixture
def rendered(monkeypatch):
    """What was asked of the renderer, which answers with recordings by rule."""
    calls = []

    def build(scenario, seed, camera):
        calls.append((scenario.name, seed))
        return make_fake_recording(seed=seed)

    monkeypatch.setattr("finforce_eval.cli.demo.build_simulated_recording", build)
    return calls


@pytest.fixture
def folder(rendered, tmp_path):
    """The demo's recording, rendered once."""
    folder = tmp_path / "report" / "recording"
    assert demo.prepare_recording(folder) == folder
    assert rendered == [("grasp_cylinder", 4)]
    return folder


def test_a_whole_recording_of_the_scene_is_used_again(folder, rendered):
    assert demo.prepare_recording(folder) == folder
    assert len(rendered) == 1 and len(read_recording(folder).images) == 12


@pytest.mark.parametrize("change", [{"scene": "hold"}, {"seed": 5}, {"finger": 1}])
def test_a_recording_of_something_else_is_rendered_anew(folder, rendered, change):
    case = json.loads((folder / "case.json").read_text())
    (folder / "case.json").write_text(json.dumps(case | change))
    demo.prepare_recording(folder)
    assert len(rendered) == 2 and json.loads((folder / "case.json").read_text()) == case


def test_a_damaged_recording_is_rendered_anew(folder, rendered):
    (folder / "metadata.yaml").unlink()
    bag = folder / "recording.mcap"
    bag.write_bytes(bag.read_bytes()[:5000])
    assert len(read_recording(demo.prepare_recording(folder)).images) == 12 and len(rendered) == 2


@pytest.mark.parametrize("name", ["notes.txt", "metadata.yaml"])
def test_what_the_demo_has_not_made_is_left_alone(rendered, tmp_path, name):
    (tmp_path / "recording").mkdir()
    (tmp_path / "recording" / name).write_text("{}")
    (tmp_path / "recording" / "recording.mcap").write_bytes(b"mine")
    with pytest.raises(RecordingError, match="something else than a recording of a synthetic scene"):
        demo.prepare_recording(tmp_path / "recording")
    assert (tmp_path / "recording" / "recording.mcap").read_bytes() == b"mine" and not rendered


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """A recording from images; the force rises by 0.1 N an image from image 20 on."""
    path = write_simulated_recording(
        make_fake_recording(FakeGripper(count=40, onset=20)), tmp_path_factory.mktemp("bags") / "twin"
    )
    recording = read_recording(path)
    return detect_keypoints(recording, FakeDetector(recording))


def grasp_of(recording, error):
    """Grasp forces that are all wrong by as much, and come 50 ms after their images."""
    stamps = recording.images.stamps_ns.tolist()
    truth = np.linalg.norm(recording.truth("left").force, axis=1)
    return dict(zip(stamps, truth + error, strict=True)), dict.fromkeys(stamps, 0.05)


def test_the_grasp_force_is_scored_against_the_smaller_true_force(played):
    score = score_grasp(played, *grasp_of(played, 0.03))
    assert score.error.rmse_N == pytest.approx(0.03) and score.error.n == 40
    assert score.largest == pytest.approx(2.0) and score.frames == 40
    # 0.02 N a fifth of a period after image 19; 0.13 N with image 20, 0.8 periods later, and 50 ms on the way
    assert score.delay["n"] == 1 and score.delay["median_ms"] == pytest.approx(0.8e3 / 30 + 50, abs=0.1)
    left = played.jaws["left"]
    weaker = replace(left, truth=replace(left.truth, force=0.5 * left.truth.force))
    both = replace(played, jaws={"left": left, "right": weaker})
    assert score_grasp(both, *grasp_of(played, 0.0)).largest == pytest.approx(1.0)


def test_without_the_truth_of_a_jaw_nothing_is_said_of_the_grasp(played):
    left = played.jaws["left"]
    both = replace(played, jaws={"left": left, "right": replace(left, truth=None)})
    score = score_grasp(both, *grasp_of(played, 0.0))
    assert score.error.rmse_N is None and not score.delay["n"]


def replay_of(recording):
    forces = recording.truth("left").force
    jaw = FakeJaw(keypoints=np.zeros((4, 3)))
    result = evaluate_recording(recording, jaw, GivenContact(None), FakeEstimator(forces))
    grasp, lag = grasp_of(recording, 0.03)
    return Replay(
        evaluation=score_results([result], [recording]),
        grasp=grasp,
        health={},
        grasp_score=score_grasp(recording, grasp, lag),
        recording=recording,
    )


def test_the_figures_that_matter_are_error_pixels_and_delay(played):
    assert replay.format_summary(replay_of(played)) == [
        "Grasp force: 0.030 N RMSE, 0.030 N largest error, of 2.00 N at most; "
        "40 of 40 images in the record phases answered",
        "Key points: 1.00 px off in the median, 1.00 px at the 95th percentile",
        "Delay: the grasp force shows 77 ms after its true onset",
    ]


def test_images_without_an_answer_are_counted_and_not_forgiven(played):
    grasp, lag = grasp_of(played, 0.03)
    late = {stamp: value for stamp, value in grasp.items() if stamp > played.images.stamps_ns[9]}
    score = score_grasp(played, late, lag)
    assert (score.error.n, score.frames) == (30, 40)


def test_a_force_that_never_shows_is_said(played):
    grasp, lag = grasp_of(played, 0.03)
    still = replace(replay_of(played), grasp_score=score_grasp(played, dict.fromkeys(grasp, 0.0), lag))
    assert "Delay: the grasp force did not show within a second" in " ".join(replay.format_summary(still))


def answer_some(played, count):
    """A run in which so many of the 40 images were answered."""
    grasp, lag = grasp_of(played, 0.03)
    some = {stamp: grasp[stamp] for stamp in list(grasp)[-count:]}
    return replace(replay_of(played), grasp=some, grasp_score=score_grasp(played, some, lag))


@pytest.mark.parametrize(("count", "is_scored"), [(20, True), (19, False), (5, False)])
def test_no_score_comes_of_fewer_than_half_of_the_images(played, count, is_scored):
    text = "\n".join(replay.format_summary(answer_some(played, count)))
    assert f"{count} of 40 images in the record phases answered" in text
    assert ("RMSE" in text) == is_scored != ("no score" in text and "--rate 0.5" in text)


def test_depth_at_a_lower_rate_is_named_where_few_images_are_answered(played):
    alone = np.where(np.arange(len(played.images.stamps_ns)) % 4, ALONE, played.images.stamps_ns)
    slow = replace(played, images=replace(played.images, depth_stamps=alone))
    text = "\n".join(replay.format_summary(replace(answer_some(played, 10), recording=slow)))
    assert "75 % of the images have no depth: --detector depth=none" in text and "--rate" not in text


@pytest.mark.parametrize(("depth", "is_alone"), [("auto", False), ("none", True)])
def test_images_without_depth_are_played_and_scored_too(depth, is_alone, played):
    half = len(played.images.stamps_ns) // 2
    images = replace(
        played.images,
        stamps_ns=played.images.stamps_ns[:half],
        depth_stamps=played.images.stamps_ns[:half],
        unpaired=played.images.stamps_ns[half:],
    )
    source = KeypointSource(source="images", parameters={"depth": depth})
    with ExitStack() as stack:
        chosen = _choose_keypoints(replace(played, images=images), load_jaw("bench"), source, stack).images
    assert np.array_equal(chosen.stamps_ns, played.images.stamps_ns)
    assert np.array_equal(chosen.depth_stamps == ALONE, (np.arange(2 * half) >= half) | is_alone)


def test_the_demo_plays_its_recording_and_ends_with_figures_and_report(rendered, played, tmp_path, monkeypatch, capsys):
    asked = {}

    def play(recording, setup, *, calibration_file, playing, keypoints):
        asked.update(recording=recording, calibration=calibration_file, source=keypoints.source, about=setup.about)
        return replay_of(played)

    monkeypatch.setattr(replay, "replay", play)
    demo.run(Namespace(source="images", contact=[], rate="1", report=str(tmp_path / "report")))
    assert asked["recording"].path == tmp_path / "report" / demo.SCENE
    assert (asked["calibration"], asked["source"], asked["about"]["contact"]) == ("twin", "images", "estimate")
    lines = capsys.readouterr().out.splitlines()
    assert lines[-2] == f"Report: {tmp_path / 'report' / 'report.html'}" and "launch" in lines[-1]
    assert [line.split(":")[0] for line in lines[-5:-2]] == ["Grasp force", "Key points", "Delay"]


def test_a_demo_that_answers_too_few_images_is_played_again_slower(rendered, played, tmp_path, monkeypatch, capsys):
    rates = []

    def play(recording, setup, *, calibration_file, playing, keypoints):
        rates.append(playing.rate)
        return answer_some(played, 5 if len(rates) == 1 else 40)

    monkeypatch.setattr(replay, "replay", play)
    demo.run(Namespace(source="images", contact=[], rate="1", report=str(tmp_path / "report")))
    assert rates == [1.0, 0.25] and "0.030 N RMSE" in capsys.readouterr().out


def test_page_and_terminal_give_one_figure_with_a_picture_of_the_grasp_on_top(
    rendered, played, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(replay, "replay", lambda *_, **__: replay_of(played))
    demo.run(Namespace(source="images", contact=[], rate="1", report=str(tmp_path / "report")))
    page = (tmp_path / "report" / "report.html").read_text()
    data = json.loads(page.partition('id="data">')[2].partition("</script>")[0])
    printed = capsys.readouterr().out.splitlines()
    assert data["headline"] in printed and data["headline"].startswith("Grasp force: 0.030 N RMSE")
    grasp = (tmp_path / "report" / replay.GRASP).read_bytes()
    assert b64decode(data["pictures"][0].partition(",")[2]) == grasp and len(data["pictures"]) == 2
    assert "measured" not in page
    assert len([line for line in printed if line and not line.startswith(("Playing", "Rendering"))]) <= 5
