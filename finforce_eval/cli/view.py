"""The subcommand `view`: a recording in Rerun: key points, bending jaws, contact, forces over time."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from shutil import which
from socket import create_connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finforce.messages import NANOSECONDS
from finforce.optional import import_cv2, import_library, import_trimesh
from finforce_eval.annotation.video import REFUSED, USED, to_bytes
from finforce_eval.cli.parser import BAG_HELP, CommandResult, add_run_options
from finforce_eval.errors import OptionError
from finforce_eval.evaluation.forces import ImageRun, estimate_shown
from finforce_eval.evaluation.gripper import combine_jaws
from finforce_eval.evaluation.setup import make_setup, read_keypoints
from finforce_eval.recordings.tracks import JawTrack, Recording
from finforce_eval.table import ForceSeries
from finforce_ifea.estimator import ForceEstimator
from finforce_ifea.messages import ARROW, CONTACT, CONTACT_DIAMETER, FORCE, NEWTONS_PER_METRE


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument("bags", nargs=1, metavar="BAG", help=BAG_HELP)
    text = "write a Rerun file instead of opening the viewer"
    parser.add_argument("--save", metavar="FILE.rrd", help=text)
    add_run_options(parser)


def run(options: argparse.Namespace) -> CommandResult:
    """Find the forces of a recording and show them with its pictures."""
    if options.save and not options.save.endswith(".rrd"):
        raise OptionError(f"--save {options.save}: expected a name that ends in .rrd")
    if not (options.save or sys.platform != "linux" or any(map(os.environ.get, DISPLAYS))):
        raise OptionError(f"no screen to show it on, as over SSH ({', '.join(DISPLAYS)}): expected --save FILE.rrd")
    setup = make_setup(options)
    (recording,) = read_keypoints(options)
    view = _RerunView(recording.name, Path(options.save) if options.save else None)
    jaws = estimate_shown(recording, setup, run=ImageRun(watch=view.show_shape))
    frames = sum(map(len, jaws.values()))
    view.show_images(recording)
    view.show_poses(recording)
    view.show_forces(jaws, combine_jaws(jaws), recording)
    view.close()
    if options.save:
        print(f"{options.save}: {frames} images of {', '.join(jaws)}; open it with: rerun {options.save}")
    return CommandResult({"file": options.save, "images": frames, "jaws": list(jaws)})


DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")  # variables, of which a desktop sets one
PORT = 9876  # of a local viewer, by default
TIMELINE = "recording"
_QUALITY = 80  # of the pictures, JPEG
_COLOURS = {"left": (0, 114, 178), "right": (213, 94, 0), "grasp": (0, 158, 115), "truth": (204, 204, 204)}


class _RerunView:
    """Sends a recording to Rerun.

    Args:
        name: of the recording.
        file: .rrd file to be written; None opens the viewer.

    Raises:
        MissingDependencyError: Rerun is not installed.
        OSError: the file cannot be written, or there is no viewer.
    """

    def __init__(self, name: str, file: Path | None) -> None:
        self._rr = rr = import_library("rerun", "finforce view", "'finforce[view]'")
        self._stream = rr.RecordingStream("finforce", recording_id=name)
        layout = _lay_out(import_library("rerun.blueprint", "finforce view", "'finforce[view]'"))
        if file is None:
            beside = os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", "")))
            try:  # the viewer of this environment, active or not
                viewer = which("rerun", path=beside)
                rr.spawn(port=PORT, executable_path=viewer, recording=self._stream, connect=False)
                create_connection(("127.0.0.1", PORT), timeout=5.0).close()  # one without a screen is gone by now
            except (RuntimeError, OSError) as error:
                raise OptionError(f"Rerun's viewer does not start; --save FILE.rrd needs none: {error}") from error
            self._stream.connect_grpc(f"rerun+http://127.0.0.1:{PORT}/proxy", default_blueprint=layout)
            return
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("wb"):
            pass  # Rerun says nothing of a file that it cannot write
        self._stream.save(str(file), default_blueprint=layout)

    def close(self) -> None:
        """Send what is left."""
        self._stream.flush()
        self._stream.disconnect()

    def _at(self, stamp: int) -> None:
        """Go to a time [ns]."""
        self._stream.set_time(TIMELINE, timestamp=stamp / NANOSECONDS)

    def show_images(self, recording: Recording) -> None:
        """Send the pictures, and the key points that were found in each."""
        rr, cv2 = self._rr, import_cv2()
        if recording.images is None:
            return
        for stamp, image in recording.images.all_colors():
            self._at(stamp)
            picture = cv2.cvtColor(image.color, cv2.COLOR_RGB2BGR)
            data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
            self._stream.log("camera", rr.EncodedImage(contents=data, media_type="image/jpeg"))
        for side, track in recording.jaws.items():
            self._show_pixels(side, track)

    def _show_pixels(self, side: str, track: JawTrack) -> None:
        """Send where the key points of a jaw were found in the pictures."""
        found = track.detection
        for row, stamp in enumerate(found.stamps_ns.tolist() if found is not None else ()):
            seen = np.isfinite(found.pixels[row]).all(axis=1)
            colours = [USED if accepted else REFUSED for accepted in found.accepted[row][seen]]
            self._at(stamp)
            points = self._rr.Points2D(found.pixels[row][seen], colors=colours, radii=2.5)
            self._stream.log(f"camera/{side}", points)

    def show_shape(self, side: str, stamp: int, estimator: ForceEstimator) -> None:
        """Send how a jaw bends in an image [ns], as its estimator has found it."""
        self._at(stamp)
        vertices, triangles = np.array(estimator.surface()), np.asarray(estimator.surface_triangles)
        normals = import_trimesh().Trimesh(vertices, triangles, process=False).vertex_normals
        mesh = self._rr.Mesh3D(
            vertex_positions=vertices.astype(np.float32),
            triangle_indices=triangles,
            vertex_normals=normals.astype(np.float32),
            albedo_factor=(150, 170, 190),
        )
        self._stream.log(f"jaws/{side}/surface", mesh)

    def show_poses(self, recording: Recording) -> None:
        """Send where the jaws are in the camera's frame, as far as that is known."""
        axes = self._rr.ViewCoordinates
        is_placed = any(track.pose is not None for track in recording.jaws.values())
        # the camera's frame is shown as it looks, that of a jaw with its tip down
        self._stream.log("jaws", axes.RDF if is_placed else axes.RIGHT_HAND_Z_DOWN, static=True)
        for side, track in recording.jaws.items():
            pose = track.pose
            for row, stamp in enumerate(pose.stamps_ns.tolist() if pose is not None else ()):
                self._at(stamp)
                transform = self._rr.Transform3D(translation=pose.position[row], quaternion=pose.quaternion[row])
                self._stream.log(f"jaws/{side}", transform)

    def show_forces(self, jaws: Mapping[str, ForceSeries], grasp: ForceSeries, recording: Recording) -> None:
        """Send contact and force in the jaws, and all forces over time."""
        for side, forces in jaws.items():
            self._draw_force(forces)
            magnitude = forces.magnitude
            stated = np.linalg.norm(forces.column("force_stddev"), axis=1)
            self._plot(f"forces/{side}", forces.stamps_ns, magnitude, _COLOURS[side], f"{side} [N]")
            self._plot(
                f"deviations/{side}", forces.stamps_ns, stated, _COLOURS[side], f"{side}, standard deviation [N]"
            )
            truth = recording.jaw(side).truth
            if truth is not None:
                true = np.linalg.norm(truth.force, axis=1)
                self._plot(f"forces/{side}_true", truth.stamps_ns, true, _COLOURS["truth"], f"{side}, true [N]")
        self._plot("forces/grasp", grasp.stamps_ns, grasp.column("grasp_force"), _COLOURS["grasp"], "grasp [N]")

    def _draw_force(self, forces: ForceSeries) -> None:
        """Send where the object presses on a jaw, and how hard; nothing where that is not known."""
        rr, side = self._rr, forces.side
        rows = zip(forces.stamps_ns.tolist(), forces.force, forces.column("contact_point"), strict=True)
        for stamp, force, point in rows:
            known = np.isfinite(force).all() and np.isfinite(point).all() and force.any()
            self._at(stamp)
            if not known:
                self._stream.log(f"jaws/{side}/force", rr.Clear(recursive=True))
                continue
            vector = force / NEWTONS_PER_METRE
            arrow = rr.Arrows3D(vectors=[vector], origins=[point - vector], colors=to_bytes(FORCE), radii=ARROW[0] / 2)
            self._stream.log(f"jaws/{side}/force/arrow", arrow)
            contact = rr.Points3D([point], colors=to_bytes(CONTACT), radii=CONTACT_DIAMETER / 2)
            self._stream.log(f"jaws/{side}/force/contact", contact)

    def _plot(self, path: str, stamps: NDArray[np.int64], values: NDArray, colour: tuple, name: str) -> None:
        """Send a curve; values that are not known leave a gap."""
        rr = self._rr
        self._stream.log(path, rr.SeriesLines(colors=[colour], names=[name]), static=True)
        times = rr.TimeColumn(TIMELINE, timestamp=stamps / NANOSECONDS)
        self._stream.send_columns(path, indexes=[times], columns=rr.Scalars.columns(scalars=values))


def _lay_out(rrb: Any) -> Any:
    """Return the arrangement of the views."""
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Spatial2DView(origin="camera", name="camera"), rrb.Spatial3DView(origin="jaws", name="jaws")
            ),
            rrb.Horizontal(
                rrb.TimeSeriesView(origin="forces", name="force [N]"),
                rrb.TimeSeriesView(origin="deviations", name="standard deviation [N]"),
            ),
            row_shares=[3, 2],
        ),
        collapse_panels=True,
    )
