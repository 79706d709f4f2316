"""Trains LeRobot's policies on annotated datasets and runs the processor step: `python -m lab.lerobot_trial --out DIR`.

Needs an environment with LeRobot 0.4.4 and the libraries of finforce. LeRobot itself creates the datasets, converts the
layout v2.1, and trains, without a network connection. The command fails where a policy does not train, the forces do
not change the loss, or the step does not give the numbers of the dataset.
"""

from __future__ import annotations

import argparse
import json
import logging
import multiprocessing
import os
import re
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice, product
from pathlib import Path
from time import process_time
from typing import Any

import av
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from tqdm import tqdm

from finforce.camera import CameraIntrinsics
from finforce.gripper_frames import SIDES
from finforce_eval.annotation.dataset_copy import Column, write_copy
from finforce_eval.annotation.dataset_forces import plain_columns
from finforce_eval.cli.main import main as finforce
from finforce_eval.evaluation.gripper import find_distances
from finforce_eval.lerobot import ForceProcessorStep
from finforce_eval.machine import describe_machine
from finforce_eval.policy import FEATURE, NONE, STATE, STATE_FEATURE
from finforce_eval.recordings.dataset import open_dataset, read_parquet, rows_of
from finforce_eval.recordings.frames import decode_video
from finforce_eval.recordings.recording import read_recording
from lab.harness import Figures, figures_json, format_figures
from lab.scenes import GRASP, find_scene

SCENES = [
    replace(
        GRASP,
        size="320x240",
        seed=seed,
        changes={"settle": 0.1, "record": 0.4, "closing_speed": 0.04, "clearance": 0.004},
    )
    for seed in (101, 102)
]
IMAGES = 90  # of an episode: the jaws hold the rod for the last half second
FPS = 30  # Hz of the simulated camera
HEIGHT = 41.7  # mm of the rod above the clamped base
WRIST, DEPTH = "observation.images.wrist", "observation.images.wrist_depth"
FARTHEST = 0.5  # m, white in a picture of depths
COMMON = (
    "--policy.device=cpu --policy.push_to_hub=false --policy.pretrained_backbone_weights=null --wandb.enable=false "
    "--dataset.video_backend=pyav --dataset.use_imagenet_stats=false --batch_size=2 --num_workers=0 --log_freq=1 "
    "--eval_freq=0"
)
POLICIES = {  # as small as they can be
    "act": "--policy.dim_model=32 --policy.n_heads=2 --policy.dim_feedforward=32 --policy.n_encoder_layers=1 "
    "--policy.n_vae_encoder_layers=1 --policy.chunk_size=8 --policy.n_action_steps=8",
    "diffusion": "--policy.horizon=8 --policy.n_action_steps=4 --policy.drop_n_last_frames=3 "
    "--policy.down_dims=[16,32] --policy.diffusion_step_embed_dim=16 --policy.num_train_timesteps=10 "
    "--policy.spatial_softmax_num_keypoints=8",
}
SAME = 1e-6  # N between dataset and step


@dataclass(frozen=True, kw_only=True)
class Episode:
    """Pictures (n, h, w, 3) of the wrist and of its depth, and the opening (n,) [m] of the jaws."""

    pictures: NDArray[np.uint8]
    depths: NDArray[np.uint8]
    opening: NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Session:
    """Simulated grasps, their camera, and its pose in the gripper: x, y, z [m], qx, qy, qz, qw."""

    episodes: list[Episode]
    camera: CameraIntrinsics
    pose: list[float]

    @property
    def intrinsics(self) -> list[float]:
        """Numbers of the camera as `--intrinsics` takes them."""
        camera = self.camera
        return [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion.tolist()]


def render() -> Session:
    """Return the session, from the cache of scenes if it is there."""
    episodes = []
    for scene in SCENES:
        recording = read_recording(find_scene(scene))
        images = [item.image for item in islice(recording.images.all_colors(), IMAGES)]
        depths = np.stack([np.nan_to_num(image.depth / FARTHEST, nan=0.0).clip(0.0, 1.0) for image in images])
        stamps = recording.images.all_colors().stamps_ns[:IMAGES]
        opening = find_distances(recording, stamps, true=True)
        episodes.append(
            Episode(
                pictures=np.stack([image.color for image in images]),
                depths=np.repeat(np.round(255 * depths).astype(np.uint8)[..., None], 3, axis=-1),
                opening=np.array(opening, dtype=np.float32),
            )
        )
    pose = recording.case["T_gripper_camera"]
    return Session(episodes=episodes, camera=recording.images.camera, pose=pose)


def create_v30(folder: Path, episodes: list[Episode], *, has_depth: bool) -> None:
    """Create a dataset by LeRobot: videos, the opening and its speed as state, and the next opening as action."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    number = {"dtype": "float32", "shape": (2,), "names": ["opening.pos", "opening.vel"]}
    picture = {"dtype": "video", "shape": episodes[0].pictures[0].shape, "names": ["height", "width", "channels"]}
    features = {"observation.state": number, "action": {**number, "names": ["opening.pos", "grip"]}, WRIST: picture}
    features |= {DEPTH: picture} if has_depth else {}
    dataset = LeRobotDataset.create("trial/grasps", FPS, features, root=folder, video_backend="pyav")
    for episode in episodes:
        speed = FPS * np.gradient(episode.opening)
        for row, (picture, depth) in enumerate(zip(episode.pictures, episode.depths, strict=True)):
            frame = {"observation.state": np.float32([episode.opening[row], speed[row]]), WRIST: picture}
            frame |= {"action": np.float32([episode.opening[min(row + 1, IMAGES - 1)], 1.0]), "task": "hold the rod"}
            dataset.add_frame(frame | ({DEPTH: depth} if has_depth else {}))
        dataset.save_episode()
    dataset.finalize()


def create_v21(source: Path, target: Path) -> None:
    """Write a dataset of layout v3.0 in layout v2.1, a file for every episode."""
    dataset = open_dataset(source, WRIST)
    cameras = [name for name, entry in dataset.info["features"].items() if entry["dtype"] == "video"]
    data, video = "data/chunk-000/episode_{:06d}.parquet", "videos/chunk-000/{}/episode_{:06d}.mp4"
    lines: dict[str, list[Any]] = {"episodes": [], "episodes_stats": [], "tasks": []}
    stats = pa.concat_tables([read_parquet(path) for path in sorted(source.glob("meta/episodes/*/*.parquet"))])
    for camera in cameras:
        for each in open_dataset(source, camera).episodes:
            frames = decode_video(each.video, source.name, each.begin - 0.5 / FPS)
            write_video(target / video.format(camera, each.index), list(islice(frames, each.length)))
    for each, entry in zip(dataset.episodes, stats.to_pylist(), strict=True):
        path = target / data.format(each.index)
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(rows_of(read_parquet(each.data), each, source.name), path)
        lines["episodes"].append({"episode_index": each.index, "tasks": entry["tasks"], "length": each.length})
        own: dict[str, dict[str, Any]] = {}
        for name, values in entry.items():
            if name.startswith("stats/") and name.split("/")[2] in ("min", "max", "mean", "std", "count"):
                own.setdefault(name.split("/")[1], {})[name.split("/")[2]] = values
        lines["episodes_stats"].append({"episode_index": each.index, "stats": own})
    lines["tasks"] = [{"task_index": 0, "task": stats["tasks"][0].as_py()[0]}]
    (target / "meta").mkdir()
    for name, content in lines.items():
        (target / f"meta/{name}.jsonl").write_text("".join(json.dumps(line) + "\n" for line in content))
    info = {**dataset.info, "codebase_version": "v2.1", "total_chunks": 1, "total_videos": len(lines["episodes"])}
    info |= {"data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"}
    info |= {"video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"}
    (target / "meta/info.json").write_text(json.dumps(info))


def write_video(path: Path, pictures: list[NDArray[np.uint8]]) -> None:
    """Write pictures (h, w, 3) as an H.264 video."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS, options={"crf": "18", "g": "2"})
        stream.height, stream.width, stream.pix_fmt = *pictures[0].shape[:2], "yuv420p"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def annotate(source: Path, out: Path, session: Session, *words: str) -> Path:
    """Return the annotated copy of a dataset."""
    given = [f"--extrinsics={','.join(map(str, session.pose))}", "--contact", f"fixed:{HEIGHT}"]
    given += ["--calibration", "twin", "--color", WRIST, "--intrinsics", *map(str, session.intrinsics), *words]
    if finforce(["annotate", str(source), "--out", str(out), *given]):
        raise SystemExit(f"{source} could not be annotated")
    return out / source.name


def convert(dataset: Path) -> Path:
    """Convert a dataset of layout v2.1 to v3.0 in its place, by LeRobot."""
    from lerobot.datasets.v30.convert_dataset_v21_to_v30 import convert_dataset

    convert_dataset(dataset.name, root=dataset.parent, push_to_hub=False)
    return dataset


def train(dataset: Path, policy: str, steps: int, out: Path) -> list[float]:
    """Return the losses of the steps of a training by `lerobot-train`; NaN where it ended early."""
    shutil.rmtree(out, ignore_errors=True)
    out.parent.mkdir(parents=True, exist_ok=True)
    words = [
        f"--policy.type={policy}",
        *f"{COMMON} {POLICIES[policy]}".split(),
        f"--steps={steps}",
        f"--save_freq={steps}",
    ]
    words += ["--dataset.repo_id=trial/grasps", f"--dataset.root={dataset}", f"--output_dir={out}"]
    log = out.with_name(f"{out.name}.log")
    child = multiprocessing.get_context("fork").Process(target=_train, args=(words, log))  # imports take half a minute
    child.start()
    child.join()
    losses = [float(text) for text in re.findall(r"\bloss:(\S+)", log.read_text(encoding="utf-8"))]
    return losses + [np.nan] * (steps - len(losses))


def _train(words: list[str], log: Path) -> None:
    """Call what `lerobot-train` calls, in a process of its own."""
    from lerobot.scripts.lerobot_train import main as lerobot_train

    with log.open("w", encoding="utf-8") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        logging.getLogger().handlers.clear()
        sys.argv = ["lerobot-train", *words]
        lerobot_train()


def run_step(run: Run, trained: Path, session: Session) -> dict[str, Any]:
    """Return how the step on the pictures of a dataset agrees with its state, and whether its policy can use it."""
    step = ForceProcessorStep(
        camera="wrist",
        contact_height=1e-3 * HEIGHT,
        jaw="bench",
        intrinsics=session.intrinsics,
        extrinsics=session.pose,
        calibration="twin",
        sides=SIDES if run.jaws == "both" else (run.jaws,),
        fps=FPS,
    )
    pipeline = _reload(step, trained / "pipeline")
    dataset, policy = open_dataset(run.dataset, WRIST), _Policy(trained / "checkpoints/last/pretrained_model")
    features = dataset.info["features"]
    names, differences, actions, busy = features[STATE_FEATURE]["names"], [], [], 0.0
    for each in dataset.episodes:
        pipeline.reset()
        state = np.array(rows_of(read_parquet(each.data), each, run.name)[STATE_FEATURE].to_pylist())
        frames = decode_video(each.video, run.name, each.begin - 0.5 / FPS)
        for row, picture in zip(state, islice(frames, each.length), strict=True):
            robot = dict(zip(names[: -len(step.names)], row.tolist(), strict=False))
            begin = process_time()
            observation = pipeline({"wrist": picture, **robot})
            busy += process_time() - begin
            differences.append(np.abs([observation[name] for name in names] - row).max())
            if len(differences) % 10 == 0:
                actions.append(policy.act(features, observation))
    share = busy / len(differences)
    return {
        "images": len(differences),
        "largest difference/N": float(np.max(differences)),
        "actions": len(actions),
        "finite actions": bool(np.isfinite(actions).all()),
        "of a core/(ms/image)": 1e3 * share,
        "of a core at 30 Hz/%": 100.0 * 30.0 * share,
    }


def _reload(step: ForceProcessorStep, folder: Path) -> Any:
    """Return a pipeline for the observations of a robot, with a step that was written to a file and read again."""
    from lerobot.processor import RobotProcessorPipeline
    from lerobot.processor.converters import observation_to_transition, transition_to_observation

    ends = {"to_transition": observation_to_transition, "to_output": transition_to_observation}
    RobotProcessorPipeline(steps=[step], name="robot", **ends).save_pretrained(folder)
    return RobotProcessorPipeline.from_pretrained(folder, "robot.json", **ends)


class _Policy:
    """A trained policy with its processors, as LeRobot runs it."""

    def __init__(self, checkpoint: Path) -> None:
        from lerobot.policies.act.modeling_act import ACTPolicy
        from lerobot.policies.factory import make_pre_post_processors

        self._policy = ACTPolicy.from_pretrained(checkpoint)
        self._processors = make_pre_post_processors(self._policy.config, str(checkpoint))

    def act(self, features: dict[str, Any], observation: dict[str, Any]) -> NDArray:
        """Return the action for the observation of a robot."""
        import torch
        from lerobot.datasets.utils import build_dataset_frame
        from lerobot.utils.control_utils import predict_action

        frame = build_dataset_frame(features, observation, prefix="observation")
        return predict_action(frame, self._policy, torch.device("cpu"), *self._processors, use_amp=False).numpy()


@dataclass(frozen=True, kw_only=True)
class Run:
    """A training: of which policy, on which dataset, and what this holds; `forces` is what policies see of them."""

    dataset: Path
    layout: str
    jaws: str
    has_depth: bool
    forces: str
    policy: str

    @property
    def name(self) -> str:
        """Name of its folder."""
        depth = "depth" if self.has_depth else "color"
        return "-".join((self.layout, self.jaws or "none", depth, self.forces, self.policy))

    def describe(self, losses: list[float]) -> dict[str, Any]:
        """Return a row of the table."""
        row = {"layout": self.layout, "jaws": self.jaws, "depth camera": "yes" if self.has_depth else "no"}
        row |= {"forces": self.forces, "policy": self.policy, "finite": bool(np.isfinite(losses).all())}
        return row | {"first loss": losses[0], "last loss": losses[-1], "losses": losses}


def prepare(out: Path, session: Session) -> Iterator[Run]:
    """Make the datasets and yield the trainings."""
    for has_depth in (False, True):
        name = "depth" if has_depth else "color"
        plain, old = out / "plain" / name, out / "v21" / name
        create_v30(plain, session.episodes, has_depth=has_depth)
        create_v21(plain, old)
        datasets = [Run(dataset=plain, layout="v3.0", jaws="", has_depth=has_depth, forces=NONE, policy="")]
        for layout, jaws in product(("v3.0", "v2.1"), ("both", "left")):
            source = plain if layout == "v3.0" else old
            words = ("--jaws", jaws, "--into", STATE)
            target = annotate(source, out / f"{layout}-{jaws}", session, *words)
            if layout == "v2.1":
                convert(target)
            run = Run(dataset=target, layout=layout, jaws=jaws, has_depth=has_depth, forces=STATE, policy="")
            datasets.append(run)
        if not has_depth:
            kept = annotate(plain, out / "feature", session, "--into", FEATURE)
            datasets.append(replace(datasets[1], dataset=kept, forces=FEATURE))
            zeros = erase_forces(datasets[1].dataset, out / "zeros")
            datasets.append(replace(datasets[1], dataset=zeros, forces="zeros"))
        yield from (replace(each, policy=policy) for each in datasets for policy in POLICIES)


def erase_forces(source: Path, target: Path) -> Path:
    """Copy an annotated dataset with zeros in place of the forces in its state: as many numbers, and no news."""
    dataset = open_dataset(source, WRIST)
    entry = dataset.info["features"][STATE_FEATURE]
    own = len(plain_columns(dataset)[STATE_FEATURE].entry["names"])
    rows = {each.index: np.zeros((each.length, entry["shape"][0] - own)) for each in dataset.episodes}
    target.mkdir(parents=True)
    write_copy(dataset, target, {STATE_FEATURE: Column(entry=entry, rows=rows, kept=own, has_stats=True)})
    return target


def run_trial(out: Path, steps: int) -> Figures:
    """Return the losses without and with forces, and how datasets and step agree."""
    import lerobot.scripts.lerobot_train  # noqa: F401  (trainings are forks, which need not import it again)

    session = render()
    runs, rows = list(prepare(out, session)), []
    for run in tqdm(runs, unit="training"):
        rows.append(run.describe(train(run.dataset, run.policy, steps, out / "trained" / run.name)))
    losses = {(row["policy"], row["depth camera"]): row["losses"] for row in rows if row["forces"] == NONE}
    for row in rows:
        row["as without forces"] = row["losses"] == losses[row["policy"], row["depth camera"]]
    steps_run = [
        {"layout": run.layout, "jaws": run.jaws, **run_step(run, out / "trained" / run.name, session)}
        for run in runs
        if run.forces == STATE and run.policy == "act" and not run.has_depth
    ]
    table = pd.DataFrame(rows).drop(columns="losses")
    return Figures(tables={"training": table, "step": pd.DataFrame(steps_run)})


def main() -> int:
    """Run the trial; return 1 where LeRobot does not accept something."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="new folder of datasets, trainings and trial.json")
    parser.add_argument("--steps", type=int, default=20, help="of each training (20)")
    options = parser.parse_args()
    out = options.out.resolve()
    out.mkdir(parents=True)
    figures = run_trial(out, options.steps)
    print(format_figures(figures))
    (out / "trial.json").write_text(json.dumps({**describe_machine(), **figures_json(figures)}, indent=1) + "\n")
    trained, step = figures.tables["training"], figures.tables["step"]
    seen = trained["forces"] == STATE
    passed = trained["finite"].all() and not trained.loc[seen, "as without forces"].any()
    passed &= (step["largest difference/N"] <= SAME).all() and step["finite actions"].all()
    return int(not passed)


if __name__ == "__main__":
    os.environ["HF_HUB_OFFLINE"] = "1"
    sys.exit(main())
