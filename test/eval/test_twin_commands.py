"""Claims about `finforce twin`, and about the table of a run from images."""

import json
from importlib import resources

import numpy as np
import pytest
from eval_fakes import FakeEstimator, FakeJaw, evaluate_recording
from rgbd_fakes import FakeDetector, FakeGripper, make_fake_recording

from finforce_contact.loop import GivenContact
from finforce_eval.cli.main import main, parse
from finforce_eval.cli.twin import write_simulated_recording
from finforce_eval.evaluation.keypoint_source import detect_keypoints
from finforce_eval.evaluation.score_tables import evaluation_json, format_tables, sight_table
from finforce_eval.evaluation.scoring import score_results
from finforce_eval.recordings.objects import read_friction
from finforce_eval.recordings.recording import read_recording
from finforce_sim.scenarios import SCENARIOS


@pytest.fixture
def asked(monkeypatch):
    """What `twin record` asks the renderer for, which answers with recordings by rule."""
    calls = []

    def build(scenario, seed, camera, *, finger, depth_step):
        calls.append((scenario, seed, camera, finger, depth_step))
        return make_fake_recording(seed=seed)

    monkeypatch.setattr("finforce_eval.cli.twin.build_simulated_recording", build)
    return calls


def test_every_scene_is_listed(capsys):
    assert main(["twin", "list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(SCENARIOS)
    assert "camera=bench" in lines[0] and " s " in lines[0]


def test_a_scene_is_recorded_with_its_changes(asked, tmp_path, capsys):
    bag = tmp_path / "bags" / "twin"
    words = [
        "--seed",
        "7",
        "--depth-step",
        "0.1",
        "--finger",
        "3",
        "--light",
        "dim",
        "--object",
        "block",
        "--size",
        "320x240",
        "--set",
        "displacement=0.004",
    ]
    assert main(["twin", "record", "grasp_cylinder", "-o", str(bag), *words]) == 0
    ((scenario, seed, camera, finger, depth_step),) = asked
    assert depth_step == pytest.approx(1e-4)
    assert (scenario.light, scenario.object, scenario.displacement, seed, finger) == ("dim", "block", 0.004, 7, 3)
    assert (camera.width, camera.height) == (320, 240)
    case = json.loads((bag / "case.json").read_text())
    named = [case[name] for name in ("scene", "seed", "finger", "light", "mesh")]
    assert named == ["grasp_cylinder", 7, 3, "dim", "twin/object.stl"]
    assert "friction" not in case  # the jaws alone hold it
    assert len(read_recording(bag).images) == 12
    assert str(bag) in capsys.readouterr().out


@pytest.mark.usefixtures("asked")
def test_a_recording_states_the_friction_of_an_object_that_is_guided(tmp_path):
    assert main(["twin", "record", "bench_cylinder", "-o", str(tmp_path / "bag")]) == 0
    assert read_friction(read_recording(tmp_path / "bag")) == (0.0, 0.03)


@pytest.mark.usefixtures("asked")
def test_a_recording_states_no_friction_of_a_rough_object(tmp_path):
    rough = ["grasp_cylinder", "--set", "roughness=0.5", "-o", str(tmp_path / "bag")]
    assert main(["twin", "record", *rough]) == 0
    assert read_friction(read_recording(tmp_path / "bag")) is None


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["nothing"], "expected one of"),
        (["grasp_cylinder", "--size", "640"], "WIDTHxHEIGHT"),
        (["grasp_cylinder", "--set", "mass"], "is not of type float"),
        (["grasp_cylinder", "--set", "colour=red"], "unknown number"),
        (["grasp_cylinder", "--set", "closing_speed=9"], "closing_speed"),
        (["grasp_cylinder", "--camera", "moon"], "moon"),
        (["grasp_cylinder", "--light", "moonlight"], "light: got 'moonlight', expected one of bright, dim, any"),
    ],
)
def test_what_cannot_be_recorded_is_one_line_and_two(asked, tmp_path, capsys, words, reason):
    try:
        status = main(["twin", "record", *words, "-o", str(tmp_path / "bag")])
    except SystemExit as error:
        status = error.code
    assert status == 2 and not asked and not (tmp_path / "bag").exists()
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1 and reason in said[0]


def test_a_recording_names_its_jaw_and_the_printed_command_needs_no_other_option(asked, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    own = tmp_path / "own.yaml"
    own.write_bytes((resources.files("finforce_ifea") / "jaw" / "jaws" / "bench.yaml").read_bytes())
    for name, jaw in (("plain", "bench"), ("umi", "umi"), ("mine", "own.yaml")):
        words = [] if name == "plain" else ["--jaw", jaw]
        assert main(["twin", "record", "grasp_cylinder", "-o", name, *words]) == 0
        printed = capsys.readouterr().out.splitlines()[-1].partition("finforce ")[2].split()
        monkeypatch.chdir(tmp_path.parent)  # the recording is read from elsewhere, too
        named = parse([str(tmp_path / word) if word == name else word for word in printed]).jaw
        assert named == (str(own) if name == "mine" else jaw)
        monkeypatch.chdir(tmp_path)
    assert parse(["evaluate", "umi", "--jaw", "bench"]).jaw == parse(["evaluate", "nothing"]).jaw == "bench"
    assert (
        main(["evaluate", "plain", "umi"]) == 2 and "recordings of several jaws: bench, umi" in capsys.readouterr().err
    )


def test_a_folder_that_exists_is_left_alone(asked, tmp_path, capsys):
    (tmp_path / "bag").mkdir()
    assert main(["twin", "record", "grasp_cylinder", "-o", str(tmp_path / "bag")]) == 2
    assert not asked and "exists already" in capsys.readouterr().err


@pytest.mark.parametrize("place", ["file/bag", "file/deeper/bag", "x" * 300])
def test_a_folder_that_cannot_be_made_is_named_before_anything_is_rendered(asked, tmp_path, capsys, place):
    (tmp_path / "file").write_text("no folder")
    assert main(["twin", "record", "grasp_cylinder", "-o", str(tmp_path / place)]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert not asked and len(said) == 1 and str(tmp_path / place) in said[0]
    assert "cannot be made" in said[0] and "expected a new folder where one may be written" in said[0]


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory):
    """A run from images whose estimate follows the truth one image late."""
    gripper = FakeGripper(count=40, onset=20)
    recording = read_recording(
        write_simulated_recording(make_fake_recording(gripper), tmp_path_factory.mktemp("bags") / "twin")
    )
    found = detect_keypoints(recording, FakeDetector(recording))
    late = np.vstack((np.zeros((1, 3)), recording.truth("left").force[:-1]))
    jaw = FakeJaw(keypoints=np.zeros((4, 3)))
    result = evaluate_recording(found, jaw, GivenContact(None), FakeEstimator(late))
    return score_results([result], [found])


def test_scores_of_key_points_and_of_the_onset_are_in_the_json(evaluation):
    case = json.loads(json.dumps(evaluation_json(evaluation), allow_nan=False))["cases"]["twin"]
    assert case["sight"]["pixel_median_px"] == pytest.approx(1.0, abs=1e-3)
    assert case["sight"]["point_p95_mm"] == pytest.approx(0.3, abs=1e-3)
    assert case["sight"]["visible_lost_pct"] == pytest.approx(100 / 3)
    assert case["sight"]["hidden_accepted_pct"] == 0.0
    assert case["detector_ms"]["p50"] > 0.0
    # 0.1 N more in every image: 0.02 N a fifth of a period after image 19, the first estimate above 0.1 N with image 22
    assert case["delay"]["n"] == 1 and case["delay"]["median_ms"] >= 2.8 / 0.030
    assert evaluation_json(evaluation)["all"]["sight"] == case["sight"]


def test_the_table_shows_them_and_says_what_they_are(evaluation):
    lines = format_tables(evaluation).splitlines()
    assert lines[-2].startswith("all") and "33.3" in lines[-2] and "1.00" in lines[-2]
    assert any("pixels/px" in line for line in lines) and any("hidden+" in line for line in lines)
    assert sight_table(evaluation).index.tolist() == ["twin", "all"]


def test_the_detector_of_two_jaws_is_timed_once(tmp_path):
    gripper = FakeGripper(sides=("left", "right"))
    recording = read_recording(write_simulated_recording(make_fake_recording(gripper), tmp_path / "both"))
    found = detect_keypoints(recording, FakeDetector(recording))
    results = [
        evaluate_recording(
            found,
            FakeJaw(keypoints=np.zeros((4, 3)), side=side),
            GivenContact(None),
            FakeEstimator([np.zeros(3)] * 12),
            side,
        )
        for side in ("left", "right")
    ]
    np.testing.assert_array_equal(results[0].column("detector_ms"), results[1].column("detector_ms"))
    assert score_results(results[:1], [found]).total.detector_ms["p50"] == float(
        np.median(results[0].column("detector_ms"))
    )
