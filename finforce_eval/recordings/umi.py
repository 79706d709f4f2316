"""UMI's replay buffers and UMI-FT's episodes, in Zarr, as recordings: pictures and, of UMI-FT, measured wrenches.

Source: the layouts as universal_manipulation_interface and UMI-FT write them.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finforce.gripper_frames import HALF_TURN, SIDES
from finforce.messages import NANOSECONDS
from finforce_eval.errors import RecordingError
from finforce_eval.recordings.bags import is_buffer
from finforce_eval.recordings.frames import FrameImages, choose_camera
from finforce_eval.recordings.images import ImageChoice
from finforce_eval.recordings.tracks import Recording, WrenchTrack
from finforce_eval.recordings.zarr_store import ZarrStore

ENDS, CAMERA, CAMERA_FT = "meta/episode_ends", "camera0_rgb", "rgb_0"
RATE = 60000 / 1001  # Hz of UMI's GoPro: a replay buffer does not tell its times
LARGEST_FORCE = 500.0  # N; more are counts, or newtons of something else than a finger
_FRAME_STEP = (5e-3, 0.5)  # [s], range of the steps between images; others are not in seconds
_WRENCH_STEP = (2e-4, 0.05)  # [s], range of the steps between wrenches
_FIRM = 90.0  # percentile of the forces that tell which way the sensors count
_FEEBLE = 0.1  # N of these that tell nothing


def count_episodes(path: Path) -> int:
    """Return how many episodes a buffer has; raises RecordingError where it is none of UMI or UMI-FT."""
    return len(find_episodes(ZarrStore(path))[0])


def is_replay_buffer(path: Path) -> bool:
    """Say whether a path is a buffer whose episodes follow each other in the same arrays, as UMI's."""
    return is_buffer(path) and ZarrStore(path).find(f"{ENDS}/.zarray") is not None


def find_episodes(store: ZarrStore) -> tuple[list[str], NDArray]:
    """Return the group of the arrays of each episode, and its first row and the row after its last in them (n, 2)."""
    groups = [name for name in store.list_members("data") if name.startswith("episode_")]
    if groups:
        numbered = sorted(groups, key=lambda name: (len(name), name))
        return [f"data/{name}" for name in numbered], np.tile([0, -1], (len(groups), 1))
    ends = np.r_[0, store.open_array(ENDS, (None,), "iu").read().astype(np.int64)]
    if len(ends) < 2 or not (np.diff(ends) > 0).all():
        raise RecordingError(f"{store.name}: {ENDS} {ends[1:6].tolist()}; expected rising numbers of rows")
    return ["data"] * (len(ends) - 1), np.stack((ends[:-1], ends[1:]), axis=1)


def read_buffer(path: Path, choice: ImageChoice, sides: Sequence[str] = ()) -> Recording:
    """Return one episode of a buffer as a recording whose jaws are still to be found.

    Raises:
        RecordingError: the buffer cannot be read, is of another layout, or has no such episode.
        OptionError: its camera is not described.
    """
    store = ZarrStore(path)
    groups, spans = find_episodes(store)
    if choice.episode >= len(groups):
        raise RecordingError(f"{path.name}: no episode {choice.episode}; expected 0 to {len(groups) - 1}")
    group, (begin, end) = groups[choice.episode], spans[choice.episode].tolist()
    has_times = group != "data"
    pictures = store.open_array(
        f"{group}/{choice.color or (CAMERA_FT if has_times else CAMERA)}", (None, None, None, 3), "u"
    )
    end = len(pictures) if end < 0 else end
    if pictures.dtype != np.uint8 or not begin < end <= len(pictures):
        raise RecordingError(
            f"{path.name}: {pictures.key} has {len(pictures)} pictures of {pictures.dtype}; expected rows {begin} to "
            f"{end} of uint8"
        )
    name = f"{path.name.partition('.')[0]}/episode_{choice.episode:06d}"
    times = _read_times(store, f"{group}/rgb_time_stamps_0", end, _FRAME_STEP) if has_times else None
    images = FrameImages(
        name=name,
        fps=RATE,
        camera=choose_camera(choice, pictures.shape[1:3], name),
        count=end - begin,
        read=partial(pictures.rows, begin, end),
        times=None if times is None else _nanoseconds(times, times[0]),
    )
    truth, notes = ({}, ()) if times is None else _read_wrenches(store, group, times, choice)
    return images.make_recording(path, sides, truth, notes)


def _read_times(
    store: ZarrStore, key: str, count: int | None, step: tuple[float, float], *, strictly: bool = True
) -> NDArray[np.float64]:
    """Return the times (n,) [s] of samples that follow each other by a step within bounds [s]."""
    times = store.open_array(key, (count, 1), "f").read()[:, 0].astype(float)
    steps = np.diff(times)
    middle = float(np.median(steps)) if len(steps) else 0.0
    rises = np.isfinite(times).all() and ((steps > 0.0) if strictly else (steps >= 0.0)).all()
    if not rises or not step[0] < middle < step[1]:
        raise RecordingError(
            f"{store.name}: {key}: {len(times)} times, steps of {middle:g} at the median; expected rising seconds, "
            f"{step[0]:g} to {step[1]:g} apart"
        )
    return times


def _nanoseconds(times: NDArray, start: float) -> NDArray[np.int64]:
    return np.rint((times - start) * NANOSECONDS).astype(np.int64)


def _read_wrenches(
    store: ZarrStore, group: str, times: NDArray, choice: ImageChoice
) -> tuple[dict[str, WrenchTrack], tuple[str, ...]]:
    """Return the measured wrenches by jaw, in the jaw frames, and what was made of them.

    UMI-FT's tool frame has x to the right, y down and z forward in the picture; its left finger is that at lower x. A
    camera across the gripper from where its x runs sees the jaws the other way round.
    """
    keys = {side: f"{group}/wrench_{side}_0" for side in SIDES}
    if not any(key.rpartition("/")[2] in store.list_members(group) for key in keys.values()):
        return {}, (f"{group}: no wrenches",)
    if choice.T_gripper_camera is None:
        return {}, ("wrenches left out: they are in the axes of the camera; expected --rig or --extrinsics",)
    tracks = {}
    for side, key in keys.items():
        stamps = _read_times(store, f"{group}/wrench_time_stamps_{side}_0", None, _WRENCH_STEP, strictly=False)
        force = store.open_array(key, (len(stamps), 6), "f").read()[:, :3].astype(float)
        largest = float(np.abs(force).max())
        if not largest < LARGEST_FORCE:  # or NaN
            raise RecordingError(f"{store.name}: {key}: up to {largest:g}; expected newtons, below {LARGEST_FORCE:g}")
        if stamps[-1] < times[0] or stamps[0] > times[-1]:
            raise RecordingError(
                f"{store.name}: {key} lies {stamps[0] - times[0]:.1f} s from the pictures; expected one clock"
            )
        force = force if side == "left" else force @ HALF_TURN[:3, :3]
        torque = np.full_like(force, np.nan)  # about another point than the jaw's origin
        tracks[side] = WrenchTrack(stamps_ns=_nanoseconds(stamps, times[0]), force=force, torque=torque)
    notes = []
    sizes = {side: np.linalg.norm(track.force, axis=1) for side, track in tracks.items()}
    firm = [tracks[side].force[size >= np.percentile(size, _FIRM), 0].mean() for side, size in sizes.items()]
    if np.mean(firm) > _FEEBLE:  # an object can only push a jaw away from it, towards -x
        tracks = {side: WrenchTrack(**{**vars(track), "force": -track.force}) for side, track in tracks.items()}
        notes.append("wrenches are those of the fingers on the object: taken with the other sign")
    if choice.T_gripper_camera[0][0] < 0.0:
        tracks = {"left": tracks["right"], "right": tracks["left"]}
        notes.append("wrench_left_0 is of the jaw on the left of the picture, here called right")
    return tracks, tuple(notes)
