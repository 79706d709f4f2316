"""Claims about stored equilibria of jaws on disk: built once, found again, never believed when they are not whole."""

import logging
from concurrent.futures import ProcessPoolExecutor
from dataclasses import fields, replace
from multiprocessing import get_context
from types import SimpleNamespace

import numpy as np
import pytest
from mechanics_fakes import BENCH, bench_mechanics

from finforce_ifea.contact_mechanics.pressed_jaw import PressedState
from finforce_ifea.fem.solid import SolidModel
from finforce_ifea.jaw.drawing import Drawing
from finforce_ifea.jaw.jaw import load_jaw
from finforce_ifea.mechanics import build_mechanics
from finforce_ifea.reduced import build as manifold_build
from finforce_ifea.reduced import cache as manifold_cache
from finforce_ifea.reduced.build import build_rest
from finforce_ifea.reduced.cache import cache_folder, fetch_manifold, hash_parts, name_manifold
from finforce_ifea.reduced.equilibria import Manifold
from finforce_ifea.settings import EstimatorSettings

KEY = "0123"
COARSE = EstimatorSettings(solver="reduced", mesh="coarse")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("FINFORCE_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


class Builder:
    """Counts how often it builds."""

    def __init__(self):
        self.count = 0

    def __call__(self):
        self.count += 1
        names = [field.name for field in fields(Manifold) if field.name != "young_modulus"]
        values = dict.fromkeys(names, np.full((2, 3), float(self.count)))
        loads = np.arange(16.0).reshape(2, 4, 2) * self.count
        compliance = np.broadcast_to(0.5 * np.eye(2), (2, 4, 2, 2))
        return Manifold(
            young_modulus=2.5e7, **values | {"loads": loads, "moves": 0.5 * loads, "compliance": compliance}
        )


def test_second_request_finds_what_the_first_has_built(folder):
    build = Builder()
    first, second = fetch_manifold(KEY, build), fetch_manifold(KEY, build)
    assert build.count == 1
    assert second.young_modulus == first.young_modulus == 2.5e7
    np.testing.assert_array_equal(second.loads, first.loads)
    fetch_manifold("other", build)
    assert build.count == 2


@pytest.mark.parametrize("ending", ["npz", "npy"])
def test_any_damaged_byte_costs_a_build_at_most(folder, ending):
    build, random = Builder(), np.random.default_rng(0)
    fetch_manifold(KEY, build)
    path = folder / f"{KEY}.{ending}"
    whole = path.read_bytes()
    for _ in range(300):
        damaged = bytearray(whole)
        damaged[random.integers(len(whole))] ^= 1 << random.integers(8)
        path.write_bytes(damaged)
        found = fetch_manifold(KEY, build)
        assert found.young_modulus == 2.5e7
        np.testing.assert_array_equal(found.compliance, np.broadcast_to(0.5 * np.eye(2), (2, 4, 2, 2)))
    assert build.count > 100


def test_large_tables_stay_in_their_file(folder):
    build = Builder()
    fetch_manifold(KEY, build)
    found = fetch_manifold(KEY, build)
    assert build.count == 1
    assert isinstance(found.compliance.base.base, np.memmap) and found.compliance.flags.aligned
    (folder / f"{KEY}.npy").unlink()
    fetch_manifold(KEY, build)
    assert build.count == 2


def test_what_a_killed_builder_left_is_removed_and_a_full_disk_leaves_nothing(folder, monkeypatch, caplog):
    folder.mkdir()
    (folder / f"{KEY}.99.part").write_bytes(b"half")
    fetch_manifold(KEY, Builder())
    assert not list(folder.glob("*.part"))

    def fill(file, **_):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", fill)
    with caplog.at_level(logging.WARNING):
        fetch_manifold("other", Builder())
    assert "cannot be stored" in caplog.text
    assert not list(folder.glob("*.part")) and not list(folder.glob("other.np[yz]"))


@pytest.mark.parametrize("ending", ["npz", "npy"])
@pytest.mark.parametrize("damage", [lambda data: data[: len(data) // 2], lambda data: b"", lambda data: b"no archive"])
def test_damaged_file_is_built_anew_and_said_so(folder, caplog, damage, ending):
    build = Builder()
    fetch_manifold(KEY, build)
    path = folder / f"{KEY}.{ending}"
    path.write_bytes(damage(path.read_bytes()))
    with caplog.at_level(logging.WARNING):
        fetch_manifold(KEY, build)
    assert build.count == 2
    assert "cannot be read" in caplog.text
    fetch_manifold(KEY, build)
    assert build.count == 2


def test_folder_that_cannot_be_written_costs_a_warning_only(tmp_path, monkeypatch, caplog):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("FINFORCE_CACHE", str(tmp_path / "file" / "cache"))
    build = Builder()
    with caplog.at_level(logging.WARNING):
        assert fetch_manifold(KEY, build).young_modulus == 2.5e7
    assert "cannot be stored" in caplog.text


def test_failed_build_leaves_nothing_behind(folder):
    def fail():
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        fetch_manifold(KEY, fail)
    assert not list(folder.glob("*.np[yz]")) and not list(folder.glob("*.part"))


def test_folder_is_the_users_unless_another_is_named(monkeypatch, tmp_path):
    monkeypatch.delenv("FINFORCE_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "finforce"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_folder().parts[-2:] == (".cache", "finforce")


def test_hash_tells_the_last_bit_types_and_shapes_apart(monkeypatch):
    values = np.arange(6.0)
    names = [
        hash_parts(values),
        hash_parts(np.nextafter(values, 9.0)),
        hash_parts(values.reshape(2, 3)),
        hash_parts(values.astype(np.float32)),
        hash_parts(values, "solid"),
        hash_parts(values, 0.45),
    ]
    assert len(set(names)) == len(names)
    assert hash_parts(values.copy()) == names[0]
    monkeypatch.setattr(manifold_cache, "VERSION", -1)
    assert hash_parts(values) != names[0]


def thicker(jaw, factor):
    drawing: Drawing = jaw.drawing
    return replace(
        jaw, drawing=replace(drawing, inner=replace(drawing.inner, thickness=factor * drawing.inner.thickness))
    )


@pytest.mark.parametrize("solver", ["solid", "frame"])
def test_name_depends_on_geometry_and_poissons_ratio_but_not_on_the_modulus(solver):
    def name(jaw):
        return name_manifold(build_mechanics(jaw, EstimatorSettings(solver=solver, mesh="coarse")), jaw)

    stiff = replace(BENCH, material=BENCH.material.model_copy(update={"young_modulus": 1e9}))
    squashy = replace(BENCH, material=BENCH.material.model_copy(update={"poisson_ratio": 0.3}))
    assert name(stiff) == name(BENCH)
    assert len({name(BENCH), name(squashy), name(thicker(BENCH, 1.001))}) == 3


def test_models_and_meshes_have_equilibria_of_their_own():
    names = {name_manifold(bench_mechanics(*which), BENCH) for which in (("coarse", "solid"), ("default", "solid"))}
    assert len(names | {name_manifold(bench_mechanics("coarse", "frame"), BENCH)}) == 3


def test_both_jaws_of_a_gripper_share_their_equilibria(folder, monkeypatch):
    monkeypatch.setattr(manifold_cache, "build_manifold", lambda full, modulus, *_: build_rest(full, modulus))
    left = replace(BENCH, material=BENCH.material.model_copy(update={"poisson_ratio": 0.377}))
    stiff = replace(left, material=left.material.model_copy(update={"young_modulus": 5e7}))
    first, second, stiffer = (build_mechanics(jaw, COARSE) for jaw in (left, left.mirrored(), stiff))
    assert first.model.manifold is second.model.manifold is stiffer.model.manifold
    q, ratio = np.r_[np.linspace(-1.0, 1.0, first.model.size - 2), 1.5, 1.5], 5e7 / BENCH.material.young_modulus
    scaled = np.r_[ratio * q[:-2], q[-2:]]
    np.testing.assert_allclose(stiffer.model.moves(scaled), first.model.moves(q), rtol=1e-12)
    np.testing.assert_allclose(stiffer.model.reach[:-2], ratio * first.model.reach[:-2], rtol=1e-6)
    assert len(list(folder.glob("*.npz"))) == 1


@pytest.fixture(scope="module")
def two_processes():
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        yield pool


@pytest.mark.parametrize(("name", "solver"), [("bench", "solid"), ("ssg48_fin_ray_1", "plane"), ("steel", "frame")])
def test_equilibria_are_the_same_of_one_process_and_of_two(name, solver, two_processes, monkeypatch):
    monkeypatch.setattr(manifold_build, "HEIGHTS", 3)
    jaw = load_jaw(name)
    full, modulus = build_mechanics(jaw, EstimatorSettings(mesh="coarse", solver=solver)), jaw.material.young_modulus
    alone, told = manifold_build.build_manifold(full, modulus, lambda done: None), []
    shared = manifold_build.build_manifold(full, modulus, told.append, two_processes.map)
    for name in ("heights", "rods", "depths", "loads", "moves", "compliance"):
        values = getattr(alone, name)  # to rounding: linear algebra's depends on where arrays lie
        np.testing.assert_allclose(getattr(shared, name), values, rtol=0, atol=1e-6 * np.abs(values).max())
    stretched = [manifold.shapes @ manifold.basis.T for manifold in (alone, shared)]
    np.testing.assert_allclose(*stretched, rtol=0, atol=1e-6 * np.abs(stretched[0]).max())
    assert told == sorted(told) and told[-1] == 1.0


def test_equilibria_of_another_jaw_or_with_other_loads_are_built_anew(folder, caplog):
    build = Builder()
    right = fetch_manifold(KEY, build)
    path = folder / f"{KEY}.npz"
    for stored in (path, path.with_suffix(".npy")):
        stored.rename(stored.with_stem("other"))
    with caplog.at_level(logging.WARNING):
        fetch_manifold("other", build)
    assert build.count == 2 and f"those of {KEY}" in caplog.text
    manifold_cache._write(path, replace(right, loads=2.0 * right.loads))
    with caplog.at_level(logging.WARNING):
        assert fetch_manifold(KEY, build).moves[1, 0, 0] == 3.0 * right.moves[1, 0, 0]
    assert build.count == 3 and "do not fit each other" in caplog.text


def test_a_folder_that_others_can_write_is_neither_read_nor_written(folder, caplog):
    folder.mkdir(mode=0o700)
    fetch_manifold(KEY, build := Builder())
    folder.chmod(0o777)
    with caplog.at_level(logging.WARNING):
        fetch_manifold(KEY, build)
    assert build.count == 2 and "others can write there" in caplog.text


class SnappingModel(SolidModel):
    """One unknown, how far the jaw has moved [m]."""

    def __init__(self):
        self.size, self.reach = 1, 2e-3


class SnappingContact:
    """A jaw that a spring joins to the rod, and whose force q - drop width tanh((q - 2 mm) / width) gives way."""

    surface = SimpleNamespace(heights=np.array([0.0, 0.1]))

    def __init__(self, width, drop, spring):
        self.model, self.width, self.drop, self.spring = SnappingModel(), width, drop, spring

    def set_indenter(self, indenter):
        pass

    def find_touch(self, place):
        return 0.0

    def find_depth(self, q):
        bend = np.tanh((q - 2e-3) / self.width) + np.tanh(2e-3 / self.width)
        return q + (q - self.drop * self.width * bend) / self.spring

    def linearize(self, q, place):
        stiffness = self.spring + 1.0 - self.drop / np.cosh((q - 2e-3) / self.width) ** 2
        correction = self.spring * (place[0] - self.find_depth(q)) / stiffness
        modes = np.column_stack([self.spring / stiffness, [0.0], [0.0]])
        force = self.spring * (place[0] - q - correction)
        return PressedState(True, correction, modes, force, modes, force, force, 1.0, 0.0)


@pytest.mark.parametrize("shape", [(0.1e-3, 3.0, 0.2), (0.3e-3, 3.0, 0.5), (0.6e-3, 1.4, 0.2), (1e-3, 1.25, 0.2)])
def test_a_path_ends_where_the_jaw_would_snap_over_to_another_shape(shape):
    contact, shapes = SnappingContact(*shape), np.linspace(0.0, 6e-3, 6001)
    last = int(np.flatnonzero(np.diff(contact.find_depth(shapes)) < 0.0)[0])
    depth, states = manifold_build._press_rod(contact, np.inf, 0.05)
    assert 0.98 * contact.find_depth(shapes[last]) < depth < contact.find_depth(shapes[last])
    assert np.max(states) < shapes[last]
