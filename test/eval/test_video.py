"""Claims about pictures without messages: a video and a folder of them are recordings like others."""

import shutil
from dataclasses import replace
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
from eval_fakes import FakeEstimator, FakeJaw, make_recording
from PIL import Image

from finforce.gripper_frames import ROBOT_CAMERA
from finforce.rig import Rig, RigCamera, write_rig
from finforce.transforms import pose_numbers
from finforce_contact.loop import GivenContact
from finforce_eval.annotation import video
from finforce_eval.cli.main import main
from finforce_eval.errors import DamagedError, OptionError, RecordingError
from finforce_eval.evaluation import unseen
from finforce_eval.evaluation.forces import STILL_UPDATES, ImageRun, find_forces, share_reached
from finforce_eval.evaluation.keypoint_source import detect_keypoints
from finforce_eval.recordings import frames
from finforce_eval.recordings.frames import FrameImages, read_picture
from finforce_eval.recordings.images import ImageChoice
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.tracks import DetectionTrack, PoseTrack
from finforce_eval.table import ForceSeries

CAMERA = RigCamera(width=64, height=48, fx=50.0, fy=50.0, cx=32.0, cy=24.0, model="plumb_bob")
RIG = Rig(jaw="bench", camera=CAMERA, T_gripper_camera=tuple(pose_numbers(ROBOT_CAMERA)))
CHOICE = ImageChoice(camera=RIG.intrinsics)
LEVELS = (40, 80, 120, 160, 200)


def write_pictures(folder, names=("b_10.png", "a_1.png", "b_9.png"), size=(48, 64)):
    folder.mkdir()
    for level, name in zip(LEVELS, names, strict=False):
        Image.fromarray(np.full((*size, 3), level, np.uint8)).save(folder / name)
    return folder


def write_video(path, count=5):
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=20)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for level in LEVELS[:count]:
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), level, np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def test_pictures_of_a_folder_come_in_the_order_of_their_numbers(tmp_path):
    recording = read_recording(write_pictures(tmp_path / "stills"), CHOICE)
    assert [int(image.color.mean()) for _, image in recording.images] == [80, 120, 40]
    assert set(recording.jaws) == {"left", "right"} and recording.name == "stills"
    assert (np.diff(recording.images.stamps_ns) > 0).all()


def test_frames_of_a_video_have_its_times(tmp_path):
    recording = read_recording(write_video(tmp_path / "demo.mp4"), CHOICE, ("left",))
    images = recording.images.at(recording.images.stamps_ns[1:3])
    np.testing.assert_array_equal(images.stamps_ns, [50_000_000, 100_000_000])
    np.testing.assert_allclose([image.color.mean() for _, image in images], LEVELS[1:3], atol=6)
    assert set(recording.jaws) == {"left"} and len(recording.images) == 5


def test_forces_are_drawn_where_they_act_at_the_times_of_the_images(tmp_path):
    av = pytest.importorskip("av")
    recording = read_recording(write_pictures(tmp_path / "stills"), CHOICE, ("left",))
    stamps, ahead = recording.images.stamps_ns, np.tile([0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0], (3, 1))
    pose = PoseTrack(stamps_ns=stamps, position=ahead[:, :3], quaternion=ahead[:, 3:], frame_id="camera")
    recording.jaws["left"] = replace(recording.jaws["left"], pose=pose)
    # 5 N, 25 mm: from (459, 244) to (374, 244) px, ten times those of the image
    force, point = np.full((3, 3), np.nan), np.full((3, 3), np.nan)
    force[1], point[1] = (-5.0, 0.0, 0.0), (0.014, 0.0, 0.04)
    columns = {"force": force, "force_stddev": 0.1 * np.abs(force), "contact_point": point, "message": ["", "", "late"]}
    forces = ForceSeries.build("stills", "left", stamps, status=["waiting", "ok", "late"], **columns)
    video.write_video(tmp_path / "forces.mp4", recording, {"left": forces})
    with av.open(str(tmp_path / "forces.mp4")) as file:
        frames = list(file.decode(video=0))
    np.testing.assert_allclose([frame.time for frame in frames], 1e-9 * (stamps - stamps[0]), atol=1e-3)
    shown = [frame.to_ndarray(format="rgb24").astype(int) for frame in frames]
    assert [picture.shape for picture in shown] == [(480, 640, 3)] * 3
    purple = [int((picture[..., 0] - picture[..., 1] > 60)[240:249, 390:450].sum()) for picture in shown]
    assert purple[0] == purple[2] == 0 < purple[1]
    words = [int((picture[:20] > 180).all(axis=2).sum()) for picture in shown]
    assert min(words) > 100


def test_the_deviation_beside_a_force_is_that_of_its_magnitude(tmp_path, monkeypatch):
    recording = read_recording(write_pictures(tmp_path / "stills"), CHOICE)
    stamp, words = recording.images.stamps_ns[0], []
    forces = ForceSeries.build(
        "stills",
        "left",
        [stamp],
        force=np.array([[-2.0, 0.0, 0.0]]),
        force_stddev=np.array([[0.1, 0.2, 0.4]]),
        magnitude_stddev=np.array([0.1]),
        status=np.array(["ok"]),
        contact_point=np.full((1, 3), np.nan),
    )
    cv2 = video.import_cv2()
    fake = SimpleNamespace(**{name: getattr(cv2, name) for name in dir(cv2) if not name.startswith("_")})
    fake.putText = lambda picture, text, *rest: words.append(text)
    monkeypatch.setattr(video, "import_cv2", lambda: fake)
    video.ForceOverlay(recording, {"left": forces}).draw(stamp, np.zeros((48, 64, 3), np.uint8))
    assert words == ["left: 2.00 N +- 0.10"]


def test_of_accepted_points_those_in_answered_images_count_as_within_reach_or_not():
    stamps, accepted = np.array([0, 10, 20, 30]), np.array([[1, 1, 1], [1, 1, 1], [1, 0, 1], [1, 1, 1]], bool)
    nothing = np.full((4, 3, 3), np.nan)
    found = {
        "pixels": nothing[..., :2],
        "points": nothing,
        "reasons": accepted.astype(str),
        "step_ms": nothing[:, 0, 0],
    }
    detection = DetectionTrack(stamps_ns=stamps, accepted=accepted, **found)
    force, used = (
        np.array([[np.nan] * 3, [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
        [[False] * 3, [True] * 3, [True, True, False]],
    )
    series = ForceSeries.build("a", "left", stamps[:3], force=force, used=used, status=["waiting", "ok", "ok"])
    assert share_reached(series, detection) == pytest.approx(4 / 5)
    assert share_reached(series, None) is None
    assert share_reached(series.at(np.array([0])), detection) is None


def test_without_images_there_is_nothing_to_draw_into(tmp_path):
    pytest.importorskip("av")
    recording = replace(read_recording(write_pictures(tmp_path / "stills"), CHOICE), images=None)
    with pytest.raises(RecordingError, match="no images to draw forces into; expected color images"):
        video.write_video(tmp_path / "forces.mp4", recording, {})


def test_pictures_of_another_size_than_the_rigs_are_refused(tmp_path):
    with pytest.raises(OptionError, match="96 x 72; expected 64 x 48"):
        read_recording(write_pictures(tmp_path / "stills", size=(72, 96)), CHOICE)
    with pytest.raises(OptionError, match="--rig"):
        read_recording(write_pictures(tmp_path / "others"), ImageChoice())


def test_a_picture_of_another_size_than_the_first_is_named(tmp_path):
    folder = write_pictures(tmp_path / "stills")
    shutil.copy(write_pictures(tmp_path / "turned", names=("c_11.png",), size=(64, 48)) / "c_11.png", folder)
    with pytest.raises(RecordingError, match=r"^c_11\.png: 48 x 64; expected 64 x 48 as a_1\.png has"):
        list(read_recording(folder, CHOICE).images)


def test_a_damaged_picture_or_video_is_named(tmp_path):
    folder = write_pictures(tmp_path / "stills")
    (folder / "b_9.png").write_bytes(b"no picture")
    with pytest.raises(RecordingError, match="b_9.png"):
        list(read_recording(folder, CHOICE).images)
    pytest.importorskip("av")
    (tmp_path / "demo.mp4").write_bytes(b"no video")
    with pytest.raises(RecordingError, match=r"demo\.mp4"):
        read_recording(tmp_path / "demo.mp4", CHOICE)


def test_pictures_without_a_jaw_have_no_force(tmp_path, capsys):
    folder = write_pictures(tmp_path / "stills")
    write_rig(RIG, tmp_path / "rig.yaml")
    words = ["annotate", str(folder), "--rig", str(tmp_path / "rig.yaml"), "--contact", "fixed:40"]
    assert main([*words, "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert "no key points in 3 images" in said and "hidden, out of the picture, or another rig?" in said
    assert not (tmp_path / "out" / "stills").exists()


def test_no_jaw_of_one_still_is_expected_in_the_next(tmp_path):
    recording, events = read_recording(write_pictures(tmp_path / "stills"), CHOICE), []

    class Detector:
        warnings, counts, was_still = {}, {}, False

        def reset(self):
            events.append("reset")

        def detect(self, image):
            events.append("detect")
            return {}

    for stills, expected in ((True, ["reset", "detect"] * 3), (False, ["detect"] * 3)):
        events.clear()
        with pytest.raises(RecordingError, match="no key points in 3 images"):
            detect_keypoints(recording, Detector(), stills=stills)
        assert events == expected


def test_nothing_of_one_still_is_known_in_the_next():
    recording, seen = make_recording(frames=4, phases=False), []
    recording.jaw("left").keypoints.points[...] += 1e-4 * np.arange(4)[:, None, None]  # four photographs

    class Watched(FakeEstimator):
        def update(self, observation, contact):
            seen.append((len(self.observations), observation.stamp))
            return super().update(observation, contact)

    forces = [(-float(n), 0.0, 0.0) for n in range(STILL_UPDATES)]
    jaw, how = FakeJaw(keypoints=np.zeros((4, 3))), ImageRun(strict=True, stills=True)
    found = find_forces(recording, jaw, GivenContact(None), Watched(forces), "left", how)
    assert [number for number, _ in seen] == 4 * list(range(STILL_UPDATES))  # each begins anew
    np.testing.assert_allclose(found.magnitude, STILL_UPDATES - 1)  # and settles
    times = np.array([stamp for _, stamp in seen]).reshape(4, -1)
    assert (np.diff(times, axis=1) > 0.0).all()


def test_why_key_points_were_of_no_use_for_long_is_said_with_the_time(monkeypatch):
    stamps, asked = 100_000_000 * np.arange(40), []
    monkeypatch.setattr(unseen, "explain_unseen", lambda recording, source, chosen: asked.append(chosen) or ["zoomed"])

    def describe(bad, status, detection="found"):
        forces = SimpleNamespace(stamps_ns=stamps, column=lambda name: np.where(bad, status, "ok"))
        jaws = {"right": SimpleNamespace(detection=detection)}
        recording = SimpleNamespace(jaws=jaws, images=SimpleNamespace(stamps_ns=stamps))
        return unseen.describe_unseen(recording, None, {"right": forces})

    long = (stamps >= 5e8) & (stamps <= 2e9) | (stamps == 3e9)
    assert describe(long, "unobservable") == ["right jaw, 0.5 to 2.0 s: zoomed"]
    np.testing.assert_array_equal(asked[0], stamps[5:21])
    for fine in ((long, "unloaded"), (long, "waiting"), (stamps < 9e8, "unobservable"), (long, "unobservable", None)):
        assert describe(*fine) == []


def test_frames_of_a_variable_rate_have_the_times_of_the_file(tmp_path):
    av = pytest.importorskip("av")
    shown = [0, 40, 200, 240, 1000]  # [ms]
    with av.open(str(tmp_path / "phone.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        for time, level in zip(shown, LEVELS, strict=True):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), level, np.uint8), format="rgb24")
            frame.pts, frame.time_base = time, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    images = read_recording(tmp_path / "phone.mp4", CHOICE).images
    np.testing.assert_allclose(1e-6 * images.stamps_ns, shown, atol=1.0)


def test_a_video_without_a_whole_frame_is_refused(tmp_path, monkeypatch):
    path = write_video(tmp_path / "a.avi")
    monkeypatch.setattr(frames, "decode_video", lambda *arguments, **options: iter([None] * 5))
    with pytest.raises(RecordingError, match=r"a.avi: no frame is whole.*convert it to an .mp4"):
        read_recording(path, CHOICE)


def test_a_cut_video_is_read_up_to_the_cut(tmp_path):
    whole = write_video(tmp_path / "whole.mkv").read_bytes()
    (tmp_path / "cut.mkv").write_bytes(whole[: int(0.8 * len(whole))])
    levels = [image.color.mean() for _, image in read_recording(tmp_path / "cut.mkv", CHOICE).images]
    assert 0 < len(levels) < 5
    np.testing.assert_allclose(levels, LEVELS[: len(levels)], atol=6)


def test_a_video_that_a_decoder_finds_damaged_ends_before_the_damage():
    def read():
        yield from (np.full((48, 64, 3), level, np.uint8) for level in LEVELS[:3])
        raise DamagedError("demo: damaged")

    images = FrameImages(name="demo", fps=20.0, camera=RIG.intrinsics, count=5, read=read, ends_at_damage=True)
    assert [int(image.color.mean()) for _, image in images] == list(LEVELS[:3])
    with pytest.raises(DamagedError):
        list(replace(images, ends_at_damage=False))


def draw_moving(count=60):
    """Frames (96, 128, 3) of a soft pattern that moves two pixels from one to the next."""
    rows, columns = np.mgrid[0:96, 0:400]
    wide = 128 + 50 * np.sin(columns / 9.0) * np.cos(rows / 7.0) + 40 * np.sin((rows + columns) / 23.0)
    return [np.repeat(wide[:, 2 * n : 2 * n + 128, None], 3, axis=2).astype(np.uint8) for n in range(count)]


def write_packets(path, change, codec="libx264"):
    """Write a video of `draw_moving` whose packets were changed; return its path."""
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        options = {"g": "30", "keyint_min": "30", "sc_threshold": "0"} if codec == "libx264" else {}
        stream = container.add_stream(codec, rate=30, options=options)
        stream.width, stream.height, stream.pix_fmt = 128, 96, "yuv420p"
        packets = []
        for image in draw_moving():
            packets += stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24"))
        for packet in change(packets + stream.encode()):
            container.mux(packet)
    return path


def flip_byte(packet, at):
    av, data = pytest.importorskip("av"), bytearray(bytes(packet))
    data[at if at >= 0 else len(data) + at] ^= 0x55
    changed = av.Packet(bytes(data))
    changed.pts, changed.dts, changed.time_base, changed.stream = (
        packet.pts,
        packet.dts,
        packet.time_base,
        packet.stream,
    )
    changed.is_keyframe = packet.is_keyframe
    return changed


def flip_every(packets):
    return [flip_byte(packet, len(bytes(packet)) // 2) if n == 40 else packet for n, packet in enumerate(packets)]


def read_levels(path):
    camera = replace_camera(RIG.camera.model_copy(update={"width": 128, "height": 96, "cx": 64.0, "cy": 48.0}))
    return {stamp: image.color for stamp, image in read_recording(path, ImageChoice(camera=camera)).images}


@pytest.mark.parametrize("codec", ["libx264", "mpeg4"])
def test_no_frame_is_made_of_damaged_data_and_none_is_lost_without(tmp_path, codec):
    intact = read_levels(write_packets(tmp_path / "intact.mp4", lambda packets: packets, codec))
    assert len(intact) == 60
    damaged = read_levels(write_packets(tmp_path / "damaged.mp4", flip_every, codec))
    assert 10 <= len(damaged) < 60  # the second group of pictures, or all before the damage
    for stamp, color in damaged.items():
        np.testing.assert_allclose(color.astype(int), intact[stamp], atol=2)


def test_turns_in_the_metadata_of_a_video_are_applied(tmp_path):
    content = bytearray(write_video(tmp_path / "turned.mp4").read_bytes())
    matrix = content.index(b"tkhd") + 4 + 40
    quarter = np.array([0, 1 << 16, 0, -1 << 16, 0, 0, 0, 0, 1 << 30], dtype=">i4")
    content[matrix : matrix + 36] = quarter.tobytes()
    (tmp_path / "turned.mp4").write_bytes(content)
    upright = RIG.camera.model_copy(update={"width": 48, "height": 64, "cx": 24.0, "cy": 32.0})
    images = read_recording(tmp_path / "turned.mp4", ImageChoice(camera=replace_camera(upright))).images
    assert {image.color.shape for _, image in images} == {(64, 48, 3)}


def replace_camera(camera):
    return RIG.model_copy(update={"camera": camera}).intrinsics


def test_turns_in_pictures_are_applied_and_heic_is_named(tmp_path):
    folder = tmp_path / "stills"
    folder.mkdir()
    picture = Image.fromarray(np.tile(np.arange(48, dtype=np.uint8)[:, None, None], (1, 64, 3)))
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned clockwise
    picture.save(folder / "a.png", exif=exif)
    assert (read_picture(folder / "a.png")[0, [0, -1], 0] == (47, 0)).all()
    (folder / "b.jpg").write_bytes(b"\0\0\0\x24ftypheic" + bytes(40))
    with pytest.raises(RecordingError, match="HEIC picture; expected JPEG or PNG"):
        read_picture(folder / "b.jpg")
