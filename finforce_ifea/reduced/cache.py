"""From a jaw's full mechanics to its stored equilibria, built once and found again by a hash of what they depend on.

The folder is `$FINFORCE_CACHE`, else `finforce` in the user's cache folder. What cannot be read is built anew.
"""

from __future__ import annotations

import hashlib
import logging
import os
import struct
import zlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from weakref import WeakValueDictionary
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from finforce.caches import CacheError, cache_folder, locked
from finforce.files import check_plain
from finforce_ifea.contact_mechanics.pressed_jaw import Mechanics
from finforce_ifea.fem.frame import FrameModel
from finforce_ifea.fem.plane import PlaneModel
from finforce_ifea.fem.solid import SolidModel
from finforce_ifea.jaw.jaw import Jaw
from finforce_ifea.reduced import build as manifold_build
from finforce_ifea.reduced.build import Share, build_manifold, build_rest
from finforce_ifea.reduced.equilibria import Manifold
from finforce_ifea.reduced.model import ReducedContact, ReducedModel

# To be raised when what is stored, or how it is found, changes.
VERSION = 9
# What reading a damaged archive raises, one or the other by where the damage is.
_UNREADABLE = (OSError, ValueError, KeyError, EOFError, RuntimeError, BadZipFile, struct.error, zlib.error)
# Share by which loads and motions of the first equilibria may differ by their compliances: right ones reach 0.001.
LARGEST_MISS = 0.05
# By name; two jaws of a gripper are each other's mirror image, for which the equilibria are the same.
_SHARED: WeakValueDictionary[str, Manifold] = WeakValueDictionary()
# Fields that stand in a file of their own, of which a process holds no more in memory than it uses.
_MAPPED, _BLOCK = ("compliance", "shape_compliance"), 1 << 20
_LOG = logging.getLogger(__name__)


def hash_parts(*parts: NDArray | str | float) -> str:
    """Return a name (32 hexadecimal digits) for arrays, texts and numbers, to the last bit."""
    digest = hashlib.sha256(f"manifold {VERSION}".encode())
    for part in parts:
        array = np.ascontiguousarray(part) if isinstance(part, np.ndarray) else None
        digest.update(f"|{part!r}|".encode() if array is None else f"|{array.dtype}{array.shape}|".encode())
        if array is not None:
            digest.update(array.tobytes())
    return digest.hexdigest()[:32]


def fetch_manifold(key: str, build: Callable[[], Manifold]) -> Manifold:
    """Return the stored manifold of a key, or build and store it; of two processes one builds.

    A folder that cannot be written costs a warning and the time to build anew.
    """
    try:
        path = cache_folder() / f"{key}.npz"
    except CacheError as error:
        _LOG.warning("%s; the equilibria are rebuilt", error)
        return build()
    found = _read(path)
    if found is not None:
        return found
    with locked(path.with_suffix(".lock")):
        found = _read(path)
        if found is None:
            found = build()
            _write(path, found)
    return found


def _read(path: Path) -> Manifold | None:
    """Return a stored manifold, None when there is none that can be read, or it is not what its name says."""
    try:
        if path.exists():
            check_plain(path)
        with np.load(path, allow_pickle=False) as stored:
            values = {field.name: stored[field.name] for field in fields(Manifold) if field.name not in _MAPPED}
            values |= _map_tables(path.with_suffix(".npy"), stored)
            _check(values, str(stored["key"]), path.stem)
    except FileNotFoundError:
        return None
    except _UNREADABLE as error:
        _LOG.warning("the stored equilibria %s cannot be read (%s) and are rebuilt", path.name, error)
        return None
    values["young_modulus"] = float(values["young_modulus"])
    return Manifold(**values)


def _map_tables(path: Path, stored: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """Return the tables of a file as they lie there; raises ValueError where its content is not the one stored."""
    check_plain(path)
    if _sum_up(path) != int(stored["checksum"]):
        raise ValueError(f"{path.name} has another content")
    flat, tables = np.load(path, mmap_mode="c", allow_pickle=False), {}
    for name in _MAPPED:
        shape = tuple(stored[f"{name}_shape"])
        size = int(np.prod(shape))
        tables[name], flat = np.asarray(flat[:size]).reshape(shape), flat[size:]
    return tables


def _sum_up(path: Path) -> int:
    """Return the checksum of a file."""
    total = 0
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            total = zlib.crc32(block, total)
    return total


def _check(values: Mapping[str, NDArray], key: str, expected: str) -> None:
    """Refuse what is stored under another jaw's name, or is no set of equilibria; raises ValueError."""
    if key != expected:
        raise ValueError(f"they are those of {key}")
    loads, moves = (np.diff(values[name][:2], axis=0)[0] for name in ("loads", "moves"))
    miss = np.einsum("zij,zj->zi", values["compliance"][:2].mean(axis=0), loads) - moves
    if not np.median(np.linalg.norm(miss, axis=1)) <= LARGEST_MISS * np.median(np.linalg.norm(moves, axis=1)):
        raise ValueError("their loads, motions and compliances do not fit each other")


def _write(path: Path, manifold: Manifold) -> None:
    """Store a manifold, whole or not at all; what a killed process has left of it is removed."""
    part, tables = (path.with_suffix(f".{os.getpid()}{ending}.part") for ending in ("", ".npy"))
    values = {field.name: getattr(manifold, field.name) for field in fields(Manifold)}
    large = [values.pop(name) for name in _MAPPED]
    shapes = {f"{name}_shape": table.shape for name, table in zip(_MAPPED, large, strict=True)}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for left in path.parent.glob(f"{path.stem}.*.part"):
            left.unlink(missing_ok=True)
        with tables.open("wb") as file:
            np.save(file, np.concatenate([table.ravel() for table in large]))
        with part.open("wb") as file:
            np.savez(file, key=path.stem, checksum=_sum_up(tables), **shapes, **values)
        os.replace(tables, path.with_suffix(".npy"))
        os.replace(part, path)
    except OSError as error:
        for left in (part, tables):
            with suppress(OSError):
                left.unlink(missing_ok=True)
        _LOG.warning("the equilibria cannot be stored in %s (%s); the next start rebuilds them", path.parent, error)


def reduce_mechanics(full: Mechanics, jaw: Jaw, *, linear: bool = False) -> Mechanics:
    """Return the mechanics by stored equilibria.

    Args:
        full: the mechanics that is to be reduced.
        jaw: the jaw that it describes.
        linear: the unloaded jaw's compliance alone, without the equilibria.

    Raises:
        ContactError: The jaw cannot be pressed.
    """
    modulus = jaw.material.young_modulus
    manifold = build_rest(full, modulus) if linear else _share_manifold(full, jaw)
    model = ReducedModel(manifold, full.model, full.contact.face, modulus)
    surface = full.contact.surface
    middle = surface.points[:: surface.across].copy()
    middle[:, 1] = 0.0
    stiffness = surface.stiffness.reshape(-1, surface.across).sum(1)
    surface = replace(surface, points=middle, across=1, stiffness=stiffness, probe=None)
    return Mechanics(
        mesh=full.mesh,
        model=model,
        contact=ReducedContact(model, surface, full.contact.face),
        full=None if linear else full,
    )


def _share_manifold(full: Mechanics, jaw: Jaw) -> Manifold:
    """Return the manifold of a jaw, the same one for all jaws of this process that are alike but for their modulus."""
    key = name_manifold(full, jaw)
    found = _SHARED.get(key)
    if found is None:
        found = _SHARED[key] = fetch_manifold(key, lambda: _build_watched(full, jaw))
    return found


def name_manifold(full: Mechanics, jaw: Jaw) -> str:
    """Return the hash of all that the equilibria of a jaw depend on; its modulus is none of it."""
    mesh, model = full.mesh, full.model
    parts = [mesh.nodes, mesh.elements, mesh.clamped, jaw.material.poisson_ratio, full.contact.face_x]
    if not full.contact.face.is_flat:
        parts.append(full.contact.face.x)
    if isinstance(model, SolidModel):
        parts.append(model.dof)  # the basis is numbered so
    if isinstance(model, PlaneModel):  # one for both sides
        parts[:2] = [model.plane.points, model.plane.triangles, jaw.section.width]
        parts += [jaw.section.taper] if jaw.section.taper.any() else []
        parts += [jaw.digest] if jaw.section.layers else []
    if isinstance(full.model, FrameModel):
        parts.append(repr(jaw.drawing))
    if not manifold_build.has_own_rows(full):
        parts.append("shared")
    return hash_parts(type(full.model).__name__, *map(str, manifold_build.GRID), *parts)


def store_manifold(full: Mechanics, jaw: Jaw, share: Share) -> None:
    """Build and store the manifold of a jaw, unless it is stored, its work shared among processes.

    Raises:
        ContactError: The jaw cannot be pressed.
    """
    fetch_manifold(name_manifold(full, jaw), lambda: _build_watched(full, jaw, share))


def _build_watched(full: Mechanics, jaw: Jaw, share: Share = map) -> Manifold:
    """Build the manifold under a progress bar."""
    with tqdm(total=100, desc=f"equilibria of {jaw.name}, once", unit="%", disable=None, leave=False) as bar:
        return build_manifold(full, jaw.material.young_modulus, lambda done: bar.update(int(100 * done) - bar.n), share)
