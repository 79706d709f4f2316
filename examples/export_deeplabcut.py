"""Export a DeepLabCut 3 network to the folder `network`; runs in DeepLabCut's own environment, with `pip install onnx`.

Its argument is the file in `exported-models-pytorch` that `deeplabcut.export_model("config.yaml")` writes.
"""

import sys
from pathlib import Path

import onnx  # noqa: F401 - torch asks for it only after the network has been traced
import torch
import yaml
from deeplabcut.pose_estimation_pytorch.models import PoseModel


class Maps(torch.nn.Module):
    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, image):
        maps = self.model(image)["bodypart"]
        return maps["heatmap"], maps["locref"]


if len(sys.argv) != 2:
    sys.exit("usage: python export_deeplabcut.py exported-models-pytorch/DLC_.../DLC_....pt")
saved = torch.load(sys.argv[1], map_location="cpu", weights_only=True)
if "config" not in saved:
    sys.exit(
        f"{sys.argv[1]} is a snapshot without its configuration; give the file that deeplabcut.export_model writes"
    )
model = PoseModel.build(saved["config"]["model"])
model.load_state_dict(saved["pose"])
folder = Path("network")
folder.mkdir(exist_ok=True)
axes = {name: {0: "batch", 2: "height", 3: "width"} for name in ("input", "heatmap", "locref")}
torch.onnx.export(
    Maps(model).eval(),
    (torch.zeros(1, 3, 480, 640),),
    str(folder / "network.onnx"),
    input_names=["input"],
    output_names=["heatmap", "locref"],
    dynamic_axes=axes,
    opset_version=17,
    dynamo=False,
)
(folder / "pytorch_config.yaml").write_text(yaml.safe_dump(saved["config"], sort_keys=False))
