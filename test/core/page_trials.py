"""Runs the commands and programs of README and docs as a reader would, with small inputs that are made here.

    make pages                                          # all of them
    python test/core/page_trials.py docs/twin.md        # those of some pages

Every page has a folder of its own. Prints the seconds of each command; ends with 1 where one failed. What cannot run
here says why, see `NEEDS`.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import numpy as np

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
# What a command needs that is not here, by what gives it away.
NEEDS = {
    r"^(ros2|source|rosdep|docker|export|\. )": "ROS 2 from apt, or another program",
    r"^(make|pytest)\b": "nothing more: .ci/run does it",
    r"^python examples/": "a running robot, or time: see test_examples.py and test_policy.py",
    r"fill_pages": "pages to write",
    r"\[|^finforce \w+ NAME$": "values: it is a synopsis",
    r"/dev/|--topics|live --camera": "a gripper or a camera",
    r"^lerobot-train": "another program, on data as test_annotate_lerobot.py checks them",
    r"^dask|tcp://": "another program: see test_cluster.py",
    r"DATASET|RECORDINGS": "a dataset of LeRobot: see test_annotate_lerobot.py",
    r"^finforce camera": "a video of a gripper in its holders: see test_placement.py",
    r"^finforce (echo|status)": "a system that runs: see test_monitor.py",
    r"generated\.": "the mesh of a generator: see test_reconstruction.py",
    r"launch bench": "a camera that runs",
    r"weigh weighing": "a kitchen scale: see test_weighing.py",
}
WAITS = re.compile(r"^(finforce (launch|pipeline)|python -m finforce_sim.emulator)\b")  # until Ctrl-C
PATIENCE = 20.0  # [s] after which it is told to end
QUICK = {  # options that a command is given here in addition
    "finforce twin record": "--set settle=0.1 --set record=0.3 --set closing_speed=0.06",
    "finforce bench": "--quick",
    "finforce replay": "--rate 0.25",
}
# A recording of the page in the place of BAG: images of a grasp, or key points of presses on the bench.
KEYPOINTS = ("annotate.md", "calibration.md")
WORST = 0.4  # of the true force, by which one may be off without a calibration


def list_commands(page):
    """The commands of a page, without comments."""
    from test_pages import COMMAND_BLOCKS, PROGRAMS

    for block in COMMAND_BLOCKS:
        if block.page == page.name:
            for line in block.text.replace("\\\n", " ").splitlines():
                command = re.sub(r"\s+#\s.*", "", line).strip()
                if command.split()[:1] and command.split()[0] in PROGRAMS:
                    yield command


def missing_for(command):
    """What a command needs that is not here; empty for one that is run."""
    return next((reason for pattern, reason in NEEDS.items() if re.search(pattern, command)), "")


def complete(command):
    """A command as it is run here."""
    command = command.replace("BAG...", "BAG")
    return next((f"{command} {more}" for start, more in QUICK.items() if command.startswith(start)), command)


@cache
def images_of(folder):
    """A short recording of a grasp with images, made once, or by a page before."""
    if (made := folder / "getting_started" / "BAG").exists():
        return made
    run("finforce twin record grasp_cylinder -o recorded", folder)
    return folder / "recorded"


def give(name, page, folder, shared):
    """Make what a page takes for given, by its name."""
    path, jaws = folder / name, ROOT / "finforce_ifea" / "jaw" / "jaws"
    if name in ("BAG", "FOLDER", "rest"):
        give_recording(path, page.name in KEYPOINTS or name == "FOLDER", shared)
    elif name == "OTHER_BAG":
        shutil.copytree(folder / "BAG", path)
    elif name == "my_finger.yaml":
        path.write_bytes((jaws / "bench.yaml").read_bytes())
    elif name == "my_finger_calibration.yaml":
        path.write_bytes((jaws.parent / "calibrations" / "bench.yaml").read_bytes())
    elif name in ("can.stl", "part.stl"):
        import trimesh

        mesh = trimesh.load(ROOT / "finforce_eval" / "data" / "objects" / "cylinder_25.stl")
        mesh.apply_scale(1e3 if name == "part.stl" else 1.0).export(path)
    elif name in ("FINGER.stl", "finger.jpg"):
        give_finger(path, json.loads((jaws / "umi.section.json").read_text(encoding="utf-8"))["loops"])
    elif name in ("depth.png", "mask.png"):
        give_ball(path)
    elif name in ("demo.mp4", "rig.yaml"):
        give_video(folder, shared)


def give_recording(path, has_keypoints, shared):
    """Write a recording: images of a grasp, or key points of the included one's first 19 s, which hold four forces."""
    if not has_keypoints:
        shutil.copytree(images_of(shared), path)
        return
    from eval_fakes import cut

    import finforce as ff
    from finforce_eval.recordings.writer import write_recording

    whole = ff.read_recording(ff.DEMO)
    begin = int(whole.jaw("left").keypoints.stamps_ns[0])
    write_recording(cut(whole, begin, begin + 19 * 10**9), path)
    (path.parent / "objects").exists() or (path.parent / "objects").symlink_to(ff.DEMO.parent / "objects")


def give_video(folder, shared):
    """Write the images of a grasp as a video, and the rig file of its camera."""
    import av

    import finforce as ff
    from finforce.rig import Rig, RigCamera, RigJaw, write_rig

    recording = ff.read_recording(images_of(shared))
    with av.open(str(folder / "demo.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "10"})
        camera = recording.images.camera
        stream.width, stream.height, stream.pix_fmt = camera.width, camera.height, "yuv420p"
        for _, image in recording.images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image.color, format="rgb24")))
        container.mux(stream.encode())
    numbers = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy", "model")}
    lens = RigCamera(**numbers, distortion=tuple(camera.distortion))
    pose, jaw = tuple(recording.case["T_gripper_camera"]), RigJaw()
    write_rig(Rig(jaw="bench", camera=lens, T_gripper_camera=pose, left=jaw, right=jaw), folder / "rig.yaml")


def give_finger(path, loops):
    """Write the included finger `umi` as a surface [mm], or as a photograph beside the ruler of the page."""
    outline, *holes = sorted((np.array(loop) for loop in loops), key=lambda loop: -np.ptp(loop[:, 1]))
    if path.suffix == ".stl":
        import trimesh
        from shapely import Polygon

        trimesh.creation.extrude_polygon(Polygon(outline, holes), 25.8).export(path)
        return
    import cv2

    picture = np.full((1500, 1000, 3), 20, np.uint8)  # ten pixels a millimetre
    corner = np.array([500.0, 1400.0])
    for loop, light in ((outline, 220), *((hole, 20) for hole in holes)):
        pixels = corner + (loop - outline.min(axis=0)) * [10.0, -10.0]
        cv2.fillPoly(picture, [np.round(pixels).astype(np.int32)], (light,) * 3, cv2.LINE_AA)
    cv2.imwrite(str(path), picture)


def give_ball(path):
    """Write depth [mm] or mask of a ball of 60 mm on a table, from straight above."""
    import cv2

    v, u = np.mgrid[:480, :848]
    rays = np.stack([(u - 424.6) / 431.2, (v - 241.3) / 430.0, np.ones(u.shape)], axis=-1)
    square, along = (rays**2).sum(axis=-1), 0.30 * rays[..., 2]
    inside = along**2 - square * (0.30**2 - 0.03**2)
    depth = np.where(inside > 0.0, (along - np.sqrt(np.maximum(inside, 0.0))) / square, 0.33)
    image = np.where(inside > 0.0, 255, 0) if path.name == "mask.png" else np.rint(1e3 * depth)
    cv2.imwrite(str(path), image.astype(np.uint8 if path.name == "mask.png" else np.uint16))


GIVEN = ("BAG", "OTHER_BAG", "FOLDER", "rest", "my_finger.yaml", "my_finger_calibration.yaml", "can.stl", "part.stl")
GIVEN += ("FINGER.stl", "finger.jpg", "depth.png", "mask.png", "demo.mp4", "rig.yaml")


def give_all(command, page, folder, shared):
    """Make what a command reads and no command before it has written."""
    written = re.findall(r"(?:-o|--output|--out|--picture|--report|--save|--json) (\S+)", command)
    for name in GIVEN:
        is_named = re.search(rf"(?<![\w.]){re.escape(name)}(?![\w.])", command)
        if is_named and name not in written and not (folder / name).exists():
            give(name, page, folder, shared)


def run(command, folder):
    """Run a command in a shell, or until it is told to end; its exit status."""
    bin_folder = folder / "bin"
    bin_folder.mkdir(exist_ok=True)
    for name, words in (("finforce", "-m finforce_eval.cli.main "), ("python", "")):
        (bin_folder / name).write_text(f'#!/bin/sh\nexec "{sys.executable}" {words}"$@"\n')
        (bin_folder / name).chmod(0o755)
    environment = os.environ | {"PATH": f"{bin_folder}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    environment |= {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    with subprocess.Popen(
        ["bash", "-c", complete(command)], cwd=folder, env=environment, start_new_session=True
    ) as process:
        if not WAITS.match(command):
            return process.wait()
        try:
            return process.wait(PATIENCE) or 1  # it should not have ended
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGINT)
            return 0 if process.wait(60.0) in (0, 130, -signal.SIGINT) else 1


def run_programs(page, folder):
    """Run the programs of a page that need what its commands were given; those that failed."""
    from test_pages import PYTHON

    failed = []
    for block in PYTHON:
        if (block.page, block.wanted) == (page.name, "make pages runs it"):
            if '"DIR' in block.text:
                run("finforce evaluate finforce_eval/data/steel_r20 --jaw steel --stills --out DIR", folder)
            (folder / "program.py").write_text(block.text, encoding="utf-8")
            failed += [str(block)] if run("python program.py", folder) else []
    return failed


def run_sensor(shared):
    """Run the program with `ForceSensor` on images of a grasp; 1 where the true force is beyond what it states.

    The program has no calibration: the material of the jaw file is uncertain by 30 %, and its forces say so.
    """
    import contextlib
    import io

    from test_pages import PYTHON

    import finforce as ff

    recording = ff.read_recording(images_of(shared))
    images = [(image.stamp, image.color, image.depth) for _, image in recording.images]
    (block,) = [block for block in PYTHON if "ForceSensor" in block.text and block.wanted == "images"]
    with contextlib.redirect_stdout(io.StringIO()) as said:
        exec(compile(block.text, block.page, "exec"), {"images": images})
    told = [line.split()[1:3] for line in said.getvalue().splitlines() if line.startswith("ok ")]
    largest, stddev = max((float(force), float(deviation)) for force, deviation in told)
    true = min(np.linalg.norm(recording.truth(side).force, axis=1).max() for side in recording.jaws)
    print(f"ForceSensor: {len(told)} of {len(images)} images, {largest:.2f} +- {stddev:.2f} N, true {true:.2f} N")
    return int(not (len(told) > 20 and abs(largest - true) < 3.0 * stddev and abs(largest / true - 1.0) < WORST))


def main(pages):
    """Run the commands of pages; 1 where one of them failed."""
    failed, count, waited = [], 0, set()
    with TemporaryDirectory() as shared:
        for page in pages:
            folder = Path(shared, page.stem)
            folder.mkdir()
            for name in ("examples", "finforce_eval/data"):
                (folder / name).parent.mkdir(exist_ok=True)
                (folder / name).symlink_to(ROOT / name)
            for command in list_commands(page):
                if missing := missing_for(command):
                    print(f"- {page.name}: {command}: needs {missing}", flush=True)
                    continue
                if WAITS.match(command) and command in waited:
                    continue
                waited.add(command)
                began, count = perf_counter(), count + 1
                print(f"$ {page.name}: {command}", flush=True)
                give_all(complete(command), page, folder, Path(shared))
                if run(command, folder):
                    failed.append(f"{page.name}: {command}")
                print(f"  {perf_counter() - began:.1f} s", flush=True)
            failed += run_programs(page, folder)
            if page.name == "getting_started.md" and run_sensor(Path(shared)):
                failed.append(f"{page.name}: ForceSensor")
    print(f"{count} commands run, {len(failed)} failed", *failed, sep="\n")
    return int(bool(failed))


if __name__ == "__main__":
    sys.path[:0] = [str(ROOT), *(str(Path(__file__).parents[1] / name) for name in ("core", "eval", "ifea"))]
    sys.exit(main([Path(name).resolve() for name in sys.argv[1:]] or PAGES))
