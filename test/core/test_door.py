"""Claims about the door: what most programs need comes from `finforce`, and only what is asked for is loaded."""

import subprocess
import sys
from pathlib import Path

import pytest

import finforce

PAGE = Path(__file__).parents[2] / "docs" / "getting_started.md"


@pytest.mark.parametrize("name", finforce.__all__)
def test_every_name_of_the_door_is_there_and_named_in_its_docstring(name):
    assert getattr(finforce, name) is not None
    assert name in finforce.__doc__


@pytest.mark.parametrize("name", finforce.__all__)
def test_every_name_of_the_door_is_in_the_reference(name):
    assert f"`{name}`" in (PAGE.parent / "api" / "finforce.md").read_text(encoding="utf-8")


def test_the_door_itself_loads_no_library():
    code = "import sys; before = set(sys.modules); import finforce; print(*set(sys.modules) - before)"
    loaded = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split()
    assert "finforce" in loaded
    assert not {name.split(".")[0] for name in loaded} - {"finforce", *sys.stdlib_module_names}


def test_open3d_comes_without_its_plots_which_come_when_they_are_called():
    code = """
import sys
from finforce.optional import import_open3d
plots = import_open3d().visualization.get_plotly_fig
print("dash" in sys.modules, callable(plots))
plots([import_open3d().geometry.TriangleMesh.create_box()])
print("dash" in sys.modules)
"""
    found = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    assert found.split() == ["False", "True", "True"]


def test_an_unknown_name_is_refused_with_the_known_ones():
    with pytest.raises(AttributeError, match=r"no attribute 'load_jaws'; it has .*load_jaw,"):
        finforce.load_jaws  # noqa: B018 - the look-up is the claim


def test_names_of_files_do_where_objects_are_expected():
    jaw, calibration = finforce.load_jaw("bench"), finforce.load_calibration("bench")
    assert finforce.load_jaw(jaw) is jaw and finforce.load_jaw(jaw, "right").side == "right"
    assert finforce.load_calibration(calibration) is calibration
    assert finforce.ForceEstimator("bench", calibration="bench").jaw.name == "bench"
    assert next(finforce.iter_frames(str(finforce.DEMO))).observation.points.shape == (15, 3)
    with pytest.raises(ValueError, match="no jaw file 'bnch', did you mean bench?"):
        finforce.ForceEstimator("bnch")
    with pytest.raises(ValueError, match="no calibration file 'twinn', did you mean twin?"):
        finforce.load_calibration("twinn")


def test_a_shape_is_no_jaw_file(tmp_path):
    (tmp_path / "finger.stl").write_bytes(b"solid")
    with pytest.raises(
        ValueError, match=r"a shape, not a jaw file; make one: finforce jaw .*finger.stl -o finger.yaml"
    ):
        finforce.load_jaw(tmp_path / "finger.stl")


def test_the_example_of_getting_started_runs_and_says_what_it_prints(capsys):
    before, _, after = PAGE.read_text("utf-8").partition("\n\nprints\n\n```text\n")
    code, printed = before.rpartition("```python\n")[2].removesuffix("```"), after.partition("```")[0]
    assert len(code.splitlines()) <= 12
    assert code.count("import ") == 1
    exec(compile(code, PAGE.name, "exec"), {})
    assert capsys.readouterr().out.endswith(printed)
