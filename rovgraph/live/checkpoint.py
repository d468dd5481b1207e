"""The state of a running estimate on disk, so that it goes on after a crash.

A file is one line of text, ``rovgraph checkpoint VERSION DIGEST``, and a body to which the
digest (SHA-256) belongs: the length of a JSON text in 8 bytes, little-endian; that text, in
which an array stands as ``{"$array": [dtype, shape, offset]}``; the arrays' bytes. Nothing in
it can run code when it is read.
"""

import contextlib
import hashlib
import json
import os
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError

VERSION = 7
NAME = b"rovgraph checkpoint"
ARRAY = "$array"
NUMBERS = "biufc"  # kinds of dtypes: boolean, integer, unsigned, float, complex

_LENGTH = struct.Struct("<Q")


def write_checkpoint(path: Path | str, state: Mapping[str, Any]) -> None:
    """Write a checkpoint that appears whole or not at all; it waits for the disk.

    Parameters
    ----------
    path : an older one is replaced
    state : None, truth values, numbers, texts, NumPy arrays of numbers, and lists and dicts (with
        texts as keys) of these; a tuple comes back as a list

    Raises
    ------
    InputError : the file cannot be written; the older one stands
    TypeError : something else is in the state
    """
    path = Path(path)
    content = _encoded(state)
    partial = path.with_name(f".{path.name}.partial")
    try:
        with partial.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
        _sync_folder(path.parent)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise InputError(
            f"{path}: checkpoint cannot be written ({error.strerror}); free some space or choose another place"
        ) from None


def read_checkpoint(path: Path | str) -> dict[str, Any]:
    """Read a checkpoint; arrays are the caller's own.

    Raises
    ------
    InputError : no checkpoint, of another version, or damaged
    """
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: checkpoint cannot be read ({error.strerror}); check the name") from None
    head, _, body = content.partition(b"\n")
    if not head.startswith(NAME):
        raise InputError(f"{path}: is not a checkpoint of rovgraph; give another file")
    version, _, digest = head.removeprefix(NAME + b" ").partition(b" ")
    if version.isdigit() and int(version) != VERSION:
        raise InputError(
            f"{path}: checkpoint of version {int(version)}, expected {VERSION}; "
            "continue with the version that wrote it, or delete it to start again"
        )
    if not version.isdigit() or digest != _digest(body):
        raise InputError(f"{path}: checkpoint is damaged, its checksum differs; delete it to start again")
    return _decoded(body)


def _encoded(state: Mapping[str, Any]) -> bytes:
    arrays = bytearray()
    text = json.dumps(_packed(state, arrays, "state")).encode()
    body = b"".join([_LENGTH.pack(len(text)), text, arrays])
    return b"%s %d %s\n%s" % (NAME, VERSION, _digest(body), body)


def _decoded(body: bytes) -> dict[str, Any]:
    (length,) = _LENGTH.unpack_from(body)
    start = _LENGTH.size + length
    state: dict[str, Any] = json.loads(
        body[_LENGTH.size : start], object_hook=lambda found: _unpacked(found, body, start)
    )
    return state


def _packed(value: Any, arrays: bytearray, where: str) -> Any:
    """A value as JSON has it; bytes of arrays are appended to ``arrays``."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return _packed(value.item(), arrays, where)
    if isinstance(value, np.ndarray) and value.dtype.kind in NUMBERS:
        offset = len(arrays)
        arrays += value.tobytes()
        return {ARRAY: [value.dtype.str, value.shape, offset]}
    if isinstance(value, Mapping) and ARRAY not in value and all(isinstance(key, str) for key in value):
        return {key: _packed(item, arrays, f"{where}[{key!r}]") for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_packed(item, arrays, f"{where}[{i}]") for i, item in enumerate(value)]
    raise TypeError(f"{where} cannot be put into a checkpoint: {type(value).__name__}")


def _unpacked(found: dict[str, Any], body: bytes, start: int) -> dict[str, Any] | NDArray[Any]:
    """An object of the JSON text, or the array that it stands for."""
    if ARRAY not in found:
        return found
    dtype, shape, offset = found[ARRAY]
    count = int(np.prod(shape, dtype=np.int64))
    return np.frombuffer(body, dtype, count, start + offset).reshape(shape).copy() if count else np.empty(shape, dtype)


def _digest(body: bytes) -> bytes:
    return hashlib.sha256(body).hexdigest().encode()


def _sync_folder(folder: Path) -> None:
    """Let the new name reach the disk too, where folders can be synced."""
    if os.name == "posix":
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
