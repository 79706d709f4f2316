"""The paper's comparison: an end-to-end network, on what it was trained on and on what it was not."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from finforce.optional import import_cv2
from finforce_eval.errors import RecordingError
from finforce_eval.evaluate import evaluate_all
from finforce_eval.evaluation.scoring import rms
from finforce_eval.figures.figures import BLACK, BLUE, ORANGE
from finforce_eval.recordings.images import StampedImage
from finforce_keypoints.networks.runtime import open_session
from finforce_keypoints.networks.side_network import METADATA
from lab.experiments.experiment import (
    SHARP,
    Case,
    Experiment,
    RunOptions,
    average,
    axis_sharpness,
    build_setup,
    draw_panels,
    tabulate,
)
from lab.experiments.grasp import find_phases, join_jaws
from lab.harness import Figures

SHOWN = 10  # images that the network is given at a time
HEIGHT, WIDTH = 120, 160  # [px] of its images
FILE = Path(__file__).parents[1] / "data" / "force_network" / "force_network.onnx"
GRASP = {"settle": 0.2, "record": 0.6, "clearance": 0.003, "closing_speed": 0.004}
FIRM, SOFT, SLIGHT = 0.006, 0.004, 0.0015  # [m] of each jaw beyond first touch
SEEN, OBJECT, PLACE, LIGHT = "as trained", "another object", "another place", "dim light"
# group, name, scene, what is changed; trained is on rod25 and block, 28 to 54 mm, bright
GRASPS = (
    (SEEN, "cylinder_firm", "grasp_cylinder", {"displacement": FIRM, "height": 0.040}),
    (SEEN, "cylinder_soft", "grasp_cylinder", {"displacement": SOFT, "height": 0.046}),
    (SEEN, "cube_firm", "grasp_cube", {"displacement": FIRM, "height": 0.040}),
    (SEEN, "cube_soft", "grasp_cube", {"displacement": SOFT, "height": 0.034}),
    (OBJECT, "asymmetric_firm", "grasp_asymmetric", {"displacement": FIRM, "height": 0.040}),
    (OBJECT, "asymmetric_soft", "grasp_asymmetric", {"displacement": SOFT, "height": 0.046}),
    (OBJECT, "rod15_firm", "grasp_cylinder", {"displacement": FIRM, "height": 0.040, "object": "rod15"}),
    (OBJECT, "rod35_soft", "grasp_cylinder", {"displacement": SOFT, "height": 0.040, "object": "rod35"}),
    (PLACE, "cylinder_upper", "grasp_cylinder", {"displacement": FIRM, "height": 0.061}),
    (PLACE, "cylinder_lower", "grasp_cylinder", {"displacement": SOFT, "height": 0.022}),
    (PLACE, "cube_upper", "grasp_cube", {"displacement": FIRM, "height": 0.061}),
    (PLACE, "cube_lower", "grasp_cube", {"displacement": SLIGHT, "height": 0.022}),
    (LIGHT, "cylinder_dim", "grasp_cylinder", {"displacement": FIRM, "height": 0.040, "light": "dim"}),
    (LIGHT, "cylinder_soft_dim", "grasp_cylinder", {"displacement": SOFT, "height": 0.046, "light": "dim"}),
    (LIGHT, "cube_dim", "grasp_cube", {"displacement": FIRM, "height": 0.040, "light": "dim"}),
    (LIGHT, "cube_soft_dim", "grasp_cube", {"displacement": SOFT, "height": 0.034, "light": "dim"}),
)
QUICK = ("cylinder_firm", "asymmetric_firm", "cube_upper", "cylinder_dim")
QUICK_GRASP = {"settle": 0.1, "record": 0.3, "clearance": 0.001, "closing_speed": 0.008}


def reduce_image(color: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a colour image (h, w, 3) as the network is shown it, (120, 160, 3)."""
    return import_cv2().resize(np.ascontiguousarray(color), (WIDTH, HEIGHT), interpolation=import_cv2().INTER_AREA)


class ForceNetwork:
    """The end-to-end network; see the card beside its file."""

    def __init__(self) -> None:
        self._session = open_session(FILE, 1)
        self.about = json.loads(self._session.get_modelmeta().custom_metadata_map[METADATA])

    def predict(self, images: NDArray[np.uint8]) -> NDArray:
        """Return the grasp force (b,) [N] in the last of each row of images (b, 10, 120, 160, 3)."""
        return self._session.run(None, {"images": np.asarray(images)})[0].astype(float)

    def follow(self, images: Iterable[StampedImage]) -> tuple[NDArray[np.int64], NDArray]:
        """Return stamps (n,) [ns] of images and the grasp force (n,) [N] in each; NaN before the tenth."""
        shown: deque[NDArray] = deque(maxlen=SHOWN)
        stamps, forces = [], []
        for stamp, image in images:
            shown.append(reduce_image(image.color))
            stamps.append(stamp)
            forces.append(float(self.predict(np.stack(shown)[None])[0]) if len(shown) == SHOWN else np.nan)
        return np.array(stamps, dtype=np.int64), np.array(forces)


@cache
def load_network() -> ForceNetwork:
    """Return the network."""
    return ForceNetwork()


def list_cases(options: RunOptions) -> Sequence[Case]:
    """Return the grasps."""
    if options.bags:
        read = options.read_bags()
        blind = [case.settings["bag"] for case, recording in read if recording.images is None]
        if blind:
            raise RecordingError(f"{blind[0]}: this experiment needs colour images, which are not in it")
        return [case for case, _ in read]
    times = QUICK_GRASP if options.quick else GRASP
    return [
        options.scene_case(name, scene, times | changes, number, words={"group": group})
        for number, (group, name, scene, changes) in enumerate(GRASPS)
        if name in QUICK or not options.quick
    ]


def run(options: RunOptions, case: Case, folder: Path) -> dict[str, Any]:
    """Return the errors of both on one grasp."""
    with options.open_case(case, folder) as recording:
        stamps, forces = load_network().follow(recording.images.colors_alone())
        evaluation = evaluate_all([recording], build_setup(case.settings))
    grasp = join_jaws(evaluation, recording.name)
    grasp["network"] = grasp.stamp.map(dict(zip(stamps.tolist(), forces.tolist(), strict=True)))
    held = grasp[find_phases(grasp)["all"] & grasp.network.notna()]
    error, both = held.network - held.truth, held[held.found.notna()]
    return {
        "peak_N": float(np.nanmax(grasp.truth, initial=0.0)),
        "span_N": float(np.ptp(held.truth)) if len(held) else float("nan"),
        "rmse_N": rms((both.found - both.truth).to_numpy()),
        "network_rmse_N": rms(error.to_numpy()),
        "network_bias_N": float(error.mean()),
        "answered_pct": 100.0 * len(both) / max(len(held), 1),
        "sharpness": axis_sharpness(evaluation),
        "drawn": grasp[["seconds", "truth", "found", "network"]].round(4).to_dict("list"),
    }


def find(options: RunOptions, figures: Mapping[str, Mapping[str, Any]], folder: Path) -> Figures:
    """Return both methods' errors by what the network had seen."""
    draw_networks(figures).savefig(folder / "network.png")
    grasps = tabulate(figures)
    grasps["group"] = grasps.get("group", "recordings")
    for column in ("", "network_"):
        grasps[f"{column}nrmsd_pct"] = 100.0 * grasps[f"{column}rmse_N"] / grasps.span_N
    groups = average(grasps, ("group",), GROUPS)[["group", "n", *GROUPS.values()]]
    groups["network : finforce"] = groups["network/N"] / groups["finforce/N"]
    note = (
        "Mean over the grasps of each one's RMSE of min(|F_left|, |F_right|) while the true force is above 0.02 N; "
        f"NRMSD of each grasp's own range. The network: {load_network().about}."
    )
    each = grasps[["case", *GRASP_COLUMNS]].rename(columns={"case": "grasp", **GRASP_COLUMNS})
    return Figures(
        tables={"By familiarity of the grasp to the network": groups, "Each grasp": each},
        notes=[note],
        drawn={"Measured force (dashed), finforce (blue), network (orange)": "network.png"},
    )


GROUPS = {
    "peak_N": "peak/N",
    "rmse_N": "finforce/N",
    "nrmsd_pct": "finforce: NRMSD/%",
    "network_rmse_N": "network/N",
    "network_nrmsd_pct": "network: NRMSD/%",
}
GRASP_COLUMNS = {
    "peak_N": "peak/N",
    "rmse_N": "finforce/N",
    "network_rmse_N": "network/N",
    "network_bias_N": "network's bias/N",
    "answered_pct": "answered/%",
    **SHARP,
}


def draw_networks(figures: Mapping[str, Mapping[str, Any]]) -> Any:
    """Return a figure of the grasp force by both methods over time, a panel for each grasp."""
    rows = {f"{name} ({row.get('group', 'recording')})": row["drawn"] for name, row in figures.items()}

    def draw(axes: Any, title: str) -> None:
        grasp = pd.DataFrame(rows[title])
        axes.plot(grasp.seconds, grasp.network, color=ORANGE, linewidth=1.0)
        axes.plot(grasp.seconds, grasp.found, color=BLUE, linewidth=1.2)
        axes.plot(grasp.seconds, grasp.truth, color=BLACK, linewidth=0.9, dashes=(4, 2))

    return draw_panels(list(rows), min(len(rows), 4), "time [s]", "grasp force [N]", draw)


NETWORK = Experiment(
    name="network",
    title="Against an end-to-end network",
    about=(
        "The paper trains a network only on images and forces (ResNet-50 features of ten images, a transformer), and "
        "finds that it fails on unfamiliar grasps. The network here is of the same kind, with a smaller encoder, "
        "trained on rendered grasps of a cylinder and a cube in bright light; both methods see the same images. "
        "finforce also has the object's mesh and poses, and the finger's model; the network has neither."
    ),
    list_cases=list_cases,
    run=run,
    find=find,
)
