"""Claims about damaged recordings: what is good is read as it was, with a word of the rest; --strict refuses them."""

import struct

import numpy as np
import pytest
from eval_fakes import cut, make_recording, pack_mcap

from finforce_eval.errors import DamagedError, OutOfBoundsError, RecordingError
from finforce_eval.recordings.recording import read_recording
from finforce_eval.recordings.writer import write_recording

KINDS = [("mcap", ""), ("mcap", "lz4"), ("mcap", "zstd"), ("sqlite3", "")]
CHUNK = 0x06


def write(folder, storage="mcap", compression="", frames=900):
    """A recording of several chunks, and its one file."""
    recording = make_recording(frames=frames)
    if storage == "mcap":
        path = pack_mcap(write_recording(recording, folder / "plain"), folder / "bag.mcap", compression)
    else:
        path = next(write_recording(recording, folder / "plain", storage=storage).glob("*.db3"))
    return recording, path


def chunk_places(content):
    """Where the chunks of an mcap file begin, and how long they are."""
    place, found = 8, []
    while place + 9 <= len(content):
        opcode, length = struct.unpack_from("<BQ", content, place)
        if opcode == CHUNK:
            found.append((place, 9 + length))
        place += 9 + length
    return found


def is_part_of(read, whole):
    """Every image that was read is one of the whole recording, as it was."""
    mine, theirs = read.jaws["left"].keypoints, whole.jaws["left"].keypoints
    rows = np.searchsorted(theirs.stamps_ns, mine.stamps_ns)
    assert np.array_equal(theirs.stamps_ns[rows], mine.stamps_ns)
    assert np.allclose(theirs.points[rows], mine.points, atol=1e-6, equal_nan=True)
    return len(mine.stamps_ns) / len(theirs.stamps_ns)


@pytest.mark.parametrize(("storage", "compression"), KINDS)
@pytest.mark.parametrize("share", [0.4, 0.999])
def test_what_was_cut_off_is_read_up_to_the_end(tmp_path, storage, compression, share):
    whole, path = write(tmp_path, storage, compression)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(DamagedError, match="truncated or damaged"):
        read_recording(path, strict=True)
    read = read_recording(path)
    found = is_part_of(read, whole)
    assert found > 0.4 * share and (share < 0.95 or found > 0.8)
    assert any("read as far as it is good" in note for note in read.notes)


@pytest.mark.parametrize("compression", ["", "zstd"])
def test_a_bad_chunk_in_the_middle_costs_itself(tmp_path, compression):
    whole, path = write(tmp_path, "mcap", compression)
    content = bytearray(path.read_bytes())
    places = chunk_places(content)
    assert len(places) >= 3
    begin, length = places[len(places) // 2]
    for offset in range(200, length - 1, 997):
        content[begin + offset] ^= 0x55
    path.write_bytes(content)
    read = read_recording(path)
    share = is_part_of(read, whole)
    assert 1.0 - 2.5 / len(places) < share < 1.0
    last = whole.jaws["left"].keypoints.stamps_ns[-1]
    assert read.jaws["left"].keypoints.stamps_ns[-1] == last
    assert any("read as far as it is good" in note for note in read.notes), read.notes
    with pytest.raises(DamagedError):
        read_recording(path, strict=True)


def test_a_chunk_whose_length_is_wrong_ends_what_is_read(tmp_path):
    whole, path = write(tmp_path, "mcap", "zstd")
    content = bytearray(path.read_bytes())
    begin, _ = chunk_places(content)[1]
    struct.pack_into("<Q", content, begin + 1, 1 << 40)
    content[begin + 60] ^= 0xFF
    path.write_bytes(content)
    assert 0.05 < is_part_of(read_recording(path), whole) < 0.7


def test_a_file_without_an_index_is_read_whole(tmp_path):
    whole, path = write(tmp_path, "mcap", "zstd")
    content = path.read_bytes()
    begin, length = chunk_places(content)[-1]
    path.write_bytes(content[: begin + length])
    read = read_recording(path)
    assert is_part_of(read, whole) == 1.0 and read.notes


def test_bad_pages_in_the_middle_of_a_database_end_what_is_read(tmp_path):
    whole, path = write(tmp_path, "sqlite3")
    content = bytearray(path.read_bytes())
    middle = len(content) // 2 // 4096 * 4096
    content[middle : middle + 8192] = bytes(8192)
    path.write_bytes(content)
    read = read_recording(path)
    assert 0.3 < is_part_of(read, whole) < 0.6
    assert any("read as far as it is good" in note for note in read.notes)


def test_damaged_recordings_are_annotated_and_evaluated_with_a_word(tmp_path, capsys):
    from finforce_eval.cli.main import main
    from finforce_eval.recordings.recording import DEMO

    whole = read_recording(DEMO)
    begin = int(whole.jaw("left").keypoints.stamps_ns[0])
    short = write_recording(cut(whole, begin, begin + 8 * 10**9), tmp_path / "plain")
    path = pack_mcap(short, tmp_path / "cut.mcap", "zstd")
    begin, length = chunk_places(path.read_bytes())[-1]
    path.write_bytes(path.read_bytes()[: begin + length])
    options = [str(path), "--contact", "fixed:42", "--calibration", "bench"]
    assert main(["evaluate", *options]) == 0
    assert "read as far as it is good" in capsys.readouterr().err
    assert main(["evaluate", *options, "--strict"]) == 2
    assert main(["annotate", *options, "--out", str(tmp_path / "out"), "--strict"]) == 2
    capsys.readouterr()
    assert main(["annotate", *options, "--out", str(tmp_path / "out")]) == 0
    assert "read as far as it is good" in capsys.readouterr().err


def test_chunks_that_say_more_than_they_may_are_refused_and_names_the_way_out(tmp_path, monkeypatch):
    from finforce_eval.recordings import bags

    monkeypatch.setattr(bags, "LARGEST_ALL", 1 << 12)
    monkeypatch.setattr(bags, "PER_BYTE", 0)
    _, path = write(tmp_path, "mcap", "zstd")
    with pytest.raises(OutOfBoundsError, match="FINFORCE_BUDGET=10"):
        read_recording(path)
    monkeypatch.setenv("FINFORCE_BUDGET", "1000")
    assert len(read_recording(path).jaws["left"].keypoints.stamps_ns) == 900


def test_more_messages_than_a_file_can_hold_are_refused(tmp_path, monkeypatch):
    from finforce_eval.recordings import bags, recording

    monkeypatch.setattr(bags, "MOST_MESSAGES", 100)
    monkeypatch.setattr(bags, "BYTES_PER_MESSAGE", 1 << 20)
    monkeypatch.setattr(recording, "_CHECKED", 50)
    _, path = write(tmp_path)
    with pytest.raises(RecordingError, match="more than 100 messages"):
        read_recording(path)
