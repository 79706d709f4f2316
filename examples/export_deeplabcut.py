"""Export a DeepLabCut 3 snapshot to the folder `network`; runs in DeepLabCut's own environment."""

from pathlib import Path

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


saved = torch.load("DLC_fingers_snapshot.pt", map_location="cpu", weights_only=True)
folder = Path("network")
folder.mkdir()
(folder / "pytorch_config.yaml").write_text(yaml.safe_dump(saved["config"], sort_keys=False))
model = PoseModel.build(saved["config"]["model"])
model.load_state_dict(saved["pose"])
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
