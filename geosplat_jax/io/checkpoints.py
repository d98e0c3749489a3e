"""Checkpoints: a pytree of arrays in one ``.npz`` file, exact to the bit and without pickle.

Each leaf is a member named by its path in the tree (``['state'].params.geometry.sdf.npy``); one
more member holds JSON: the step, the caller's metadata, and each leaf's shape and type. Types that
NumPy does not know (bfloat16) are stored as unsigned integers, typed PRNG keys as their data and
the name of their generator. A file is written under another name, flushed to the disk and read
back; only then is it renamed, and older ones are removed. So there is a whole checkpoint at any
moment.
"""

import errno
import json
import math
import os
import re
import warnings
import zipfile
import zlib
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field

from geosplat_jax.core.settings import Count, first_line, from_plain, settings
from geosplat_jax.io.documents import parse_json

FORMAT = 1
"""Version of the file format."""

_META = "__meta__"
_NAME = re.compile(r"checkpoint_(\d{8,})\.npz")
_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    KeyError,
    ValueError,
    OSError,
    NotImplementedError,
)
"""Errors that reading a damaged file may raise; zip archives fail in many ways."""
_CARRIERS = {1: np.uint8, 2: np.uint16, 4: np.uint32, 8: np.uint64}


class CheckpointError(RuntimeError):
    """A checkpoint cannot be written, read, or does not fit; the message says why."""


@settings
class _Leaf:
    """A leaf of the tree as a checkpoint describes it."""

    shape: tuple[Annotated[int, Field(ge=0)], ...]
    """Shape of the array, or of the array of keys."""
    dtype: str | None = None
    """Type of an array; None for typed PRNG keys."""
    key: str | None = None
    """Name of the generator of typed PRNG keys; None for arrays."""


@settings
class _Header:
    """Description of a checkpoint, stored as JSON in its file."""

    format: Literal[1]
    """See `FORMAT`."""
    step: Count
    """Step that the checkpoint was saved at."""
    meta: dict[str, Any]
    """Metadata of the caller."""
    leaves: dict[str, _Leaf]
    """Leaves by their paths in the tree."""


def save_checkpoint(folder: str | Path, step: int, *, tree: Any, meta: dict, keep: int = 2) -> Path:
    """Write a checkpoint, and remove older ones that are no longer needed.

    Parameters
    ----------
    folder : created if it does not exist.
    step : step that the file is named after; an existing file of this step is replaced.
    tree : pytree of arrays, typed PRNG keys and Python numbers.
    meta : metadata that JSON can hold; read back by `read_meta` and `load_checkpoint`.
    keep : number of checkpoints up to this step that stay, this one included.

    Returns
    -------
    Path of the file.

    Raises
    ------
    CheckpointError : the disk is full or not writable (earlier checkpoints are then untouched, and
        no partial file remains), a leaf is not an array of numbers, the metadata are not JSON, or
        ``step`` or ``keep`` is out of range.
    """
    if step < 0 or keep < 1:
        raise CheckpointError(f"step must be >= 0 and keep >= 1, got {step} and {keep}")
    folder = Path(folder)
    path = folder / f"checkpoint_{step:08d}.npz"
    temporary_path = folder / f".{path.name}.partial"
    members, leaves = _pack(tree)
    try:
        header = json.dumps({"format": FORMAT, "step": step, "meta": meta, "leaves": leaves})
    except (TypeError, ValueError) as error:
        raise CheckpointError(f"the metadata is not JSON: {error}") from error
    members[_META] = np.frombuffer(header.encode(), np.uint8)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _write_npz(temporary_path, members)
        problem = _damage(temporary_path)
        if problem:
            raise OSError(f"reading it back failed: {problem}")
        os.replace(temporary_path, path)
        _sync_folder(folder)
    except OSError as error:
        _remove(temporary_path)
        raise CheckpointError(
            f"cannot write checkpoint {path}: {error}; earlier checkpoints are untouched. Free "
            "disk space or choose another folder, then resume"
        ) from error
    except BaseException:
        _remove(temporary_path)
        raise
    older_paths = [old_path for old_path in _listed(folder) if _step(old_path) < step]
    for old_path in older_paths[keep - 1 :]:
        _remove(old_path)
    return path


def load_checkpoint(path: str | Path, *, like: Any) -> tuple[Any, dict]:
    """Read a checkpoint into the structure of ``like``.

    Parameters
    ----------
    path : file written by `save_checkpoint`.
    like : pytree of the same structure, whose leaves give the shapes and types: arrays, typed
        PRNG keys, Python numbers or `jax.ShapeDtypeStruct`. Values are not read.

    Returns
    -------
    tree : structure of ``like``, bitwise as saved. Leaves are Python numbers or NumPy arrays where
        those of ``like`` are, else JAX arrays.
    meta : the caller's metadata.

    Raises
    ------
    CheckpointError : the file is missing or damaged, or its leaves differ from those of ``like`` in
        name, shape or type, as when the configuration has changed.
    """
    path = Path(path)
    header = _header(path)
    keyed_leaves, structure = jax.tree_util.tree_flatten_with_path(like)
    expected_leaves = {_leaf_name(key_path): leaf for key_path, leaf in keyed_leaves}
    _require_same_leaves(path, set(header.leaves), set(expected_leaves))
    try:
        with zipfile.ZipFile(path) as archive:
            leaves = [
                _unpack(path, name, header.leaves[name], _read_member(archive, name), leaf)
                for name, leaf in expected_leaves.items()
            ]
    except _DAMAGE as error:
        raise CheckpointError(f"checkpoint {path} is damaged ({error}); use another") from error
    return jax.tree_util.tree_unflatten(structure, leaves), header.meta


def latest_checkpoint(folder: str | Path) -> Path | None:
    """Find the newest undamaged checkpoint; None if there is none.

    Files are read completely, the newest first. Damaged ones are skipped with a `RuntimeWarning`.
    """
    for path in _listed(Path(folder)):
        problem = _damage(path)
        if problem is None:
            return path
        warnings.warn(
            f"checkpoint {path} is damaged ({problem}); falling back to an earlier one",
            RuntimeWarning,
            stacklevel=2,
        )
    return None


def read_meta(path: str | Path) -> dict:
    """Read the caller's metadata of a checkpoint, without its arrays.

    Raises
    ------
    CheckpointError : missing or damaged file.
    """
    return _header(Path(path)).meta


def read_step(path: str | Path) -> int:
    """Read the step a checkpoint was saved at.

    Raises
    ------
    CheckpointError : missing or damaged file.
    """
    return _header(Path(path)).step


def _leaf_name(key_path) -> str:
    return jax.tree_util.keystr(key_path) or "."


def _is_key(leaf: Any) -> bool:
    return hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _pack(tree: Any) -> tuple[dict[str, np.ndarray], dict[str, dict]]:
    """Turn leaves into plain arrays, and describe them."""
    members, descriptions = {}, {}
    for key_path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        name = _leaf_name(key_path)
        if _is_key(leaf):
            generator = str(jax.random.key_impl(leaf))
            array = np.asarray(jax.random.key_data(leaf))
            descriptions[name] = {"key": generator, "shape": list(leaf.shape)}
        else:
            array = np.asarray(leaf)
            if array.dtype.hasobject or array.dtype.kind in "USmM":
                raise CheckpointError(f"leaf {name} must be an array of numbers, got {leaf!r}")
            descriptions[name] = {"dtype": array.dtype.name, "shape": list(array.shape)}
            if array.dtype.kind == "V":  # an extension type such as bfloat16
                array = array.view(_CARRIERS[array.dtype.itemsize])
        members[name] = array
    return members, descriptions


def _unpack(path: Path, name: str, description: _Leaf, array: np.ndarray, like: Any) -> Any:
    """Turn a plain array back into a leaf, checking it against ``like``."""
    actual = {"key": description.key, "dtype": description.dtype, "shape": list(description.shape)}
    expected: dict[str, Any] = {"shape": list(np.shape(like))}
    if _is_key(like):
        expected["key"] = str(jax.random.key_impl(like)) if isinstance(like, jax.Array) else None
    else:
        expected["dtype"] = np.dtype(getattr(like, "dtype", np.asarray(like).dtype)).name
    for trait in ("key", "dtype", "shape"):
        is_open = trait == "key" and trait in expected and expected[trait] is None
        if not is_open and expected.get(trait) != actual[trait]:
            raise CheckpointError(
                f"leaf {name} of {path} has {trait} {actual[trait]}, but the run has "
                f"{expected.get(trait)}; resume with the configuration the checkpoint was made with"
            )
    if description.key is not None:
        return jax.random.wrap_key_data(jnp.asarray(array), impl=description.key)
    array = array.view(np.dtype(jnp.dtype(description.dtype))).reshape(description.shape)
    if isinstance(like, bool | int | float | complex):
        return array.item()
    return array if isinstance(like, np.ndarray | np.generic) else jnp.asarray(array)


def _require_same_leaves(path: Path, stored_names: set[str], expected_names: set[str]) -> None:
    missing, extra = sorted(expected_names - stored_names), sorted(stored_names - expected_names)
    if missing or extra:
        clauses = [
            f"{verb} {len(names)} leaves ({', '.join(names[:3])}{', ...' if names[3:] else ''})"
            for verb, names in (("lacks", missing), ("also has", extra))
            if names
        ]
        raise CheckpointError(
            f"checkpoint {path} does not fit the run: it {' and '.join(clauses)}; resume with the "
            "configuration it was made with"
        )


def _write_npz(path: Path, members: dict[str, np.ndarray]) -> None:
    """Write arrays as `numpy.savez` does, but under any names, and flush them to the disk."""
    with open(path, "wb") as file:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
            for name, array in members.items():
                with archive.open(name + ".npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)
        file.flush()
        os.fsync(file.fileno())


_ENCRYPTED = 1
"""Flag that marks an encrypted member of a zip archive."""


def _require_plain(info: zipfile.ZipInfo) -> None:
    """Refuse members that are compressed, and may expand to any size, or encrypted."""
    if info.compress_type != zipfile.ZIP_STORED or info.flag_bits & _ENCRYPTED:
        raise ValueError(f"{info.filename} is compressed or encrypted")


def _read_member(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """Read an array; memory is taken for data in the file only, whatever size the header claims.

    Raises
    ------
    ValueError
        If the member is not as `_write_npz` writes it.
    """
    info = archive.getinfo(name + ".npy")
    _require_plain(info)
    with archive.open(info) as member:
        version = np.lib.format.read_magic(member)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }.get(version)
        if read_header is None:
            raise ValueError(f"{info.filename} is of version {version}")
        shape, is_fortran, dtype = read_header(member)
        if dtype.hasobject or is_fortran:
            raise ValueError(f"{info.filename} holds no plain numbers")
        expected, content = math.prod(shape) * dtype.itemsize, member.read()
        if expected != len(content):
            raise ValueError(f"{info.filename} has {len(content)} bytes instead of {expected}")
    return np.frombuffer(content, dtype).reshape(shape).copy()


def _header(path: Path) -> _Header:
    if not path.is_file():
        raise CheckpointError(f"checkpoint {path} does not exist")
    try:
        with zipfile.ZipFile(path) as archive:
            header = parse_json(_read_member(archive, _META).tobytes())
    except _DAMAGE as error:
        raise CheckpointError(f"checkpoint {path} is damaged ({error}); use another") from error
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise CheckpointError(f"{path} is no checkpoint of format {FORMAT}")
    try:
        return from_plain(_Header, header)
    except ValueError as error:
        raise CheckpointError(f"checkpoint {path} is damaged: {first_line(error)}") from None


def _damage(path: Path) -> str | None:
    """Read the whole file and verify its checksums; return the problem, or None."""
    try:
        _header(path)
        with zipfile.ZipFile(path) as archive:
            for info in archive.infolist():
                _require_plain(info)
            bad_member = archive.testzip()
    except (CheckpointError, *_DAMAGE) as error:
        return str(error)
    return None if bad_member is None else f"checksum of {bad_member}"


def _listed(folder: Path) -> list[Path]:
    """Checkpoints of a folder, newest step first."""
    if not folder.is_dir():
        return []
    return sorted((p for p in folder.iterdir() if _NAME.fullmatch(p.name)), key=_step, reverse=True)


def _step(path: Path) -> int:
    return int(path.stem.removeprefix("checkpoint_"))


def _remove(path: Path) -> None:
    path.unlink(missing_ok=True)


_CANNOT_SYNC_FOLDERS = (errno.EINVAL, errno.ENOTSUP, errno.EACCES)
"""Errors of file systems that can flush files only; the file itself has been flushed."""


def _sync_folder(folder: Path) -> None:
    """Flush the renaming to the disk, on systems that let a folder be opened."""
    if os.name == "posix":
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        except OSError as error:
            if error.errno not in _CANNOT_SYNC_FOLDERS:
                raise
        finally:
            os.close(handle)
