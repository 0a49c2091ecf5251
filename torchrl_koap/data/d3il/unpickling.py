# This source code is licensed under the MIT license found in the LICENSE file.
"""A restricted unpickler: numpy arrays and plain containers, nothing else.

A pickle is a program. Two gates stand before this one runs:

1. The instructions are *scanned* without executing them. Every class or function a file asks for is compared with
   the short list below, and every instruction that plain data never needs (extension codes, persistent ids, class
   instances) is refused. The refusal names the file and what it asked for.
2. The file is then loaded with *stand-ins* for numpy's constructors. They check types, shapes and byte counts and
   build a view of the bytes in the file, so a declared shape can never allocate more than the file holds.
"""

from __future__ import annotations

import functools
import io
import math
import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_koap.data.d3il.pickle_scan import (
    MOST_ODD_KEYS,
    DamagedPickleError,
    UnsafePickleError,
    refusal,
    scan,
    spell,
)
from torchrl_koap.files import read_bytes

_MAX_DEPTH = 64
_ELEMENT_TYPES = re.compile(r"b1|[iu][1248]|f[248]|c8|c16|[SU][1-9]\d{0,5}")
_PLAIN = (str, bytes, bool, int, float, type(None))


def load_pickle(path: str | Path) -> Any:
    """Reads a pickle that holds nothing but numpy arrays and plain containers.

    Arrays of numbers, booleans and text are accepted, as are ``dict``, ``list``, ``tuple``, ``str``, ``bytes``, numbers
    and ``None``; written by numpy 1 or 2 with any pickle protocol. The arrays are read-only views of the file's bytes.

    Args:
        path (str or Path): the file.

    Returns:
        object: what the file holds: dicts, lists, strings, numbers and NumPy arrays.

    Raises:
        UnsafePickleError: if the file holds anything else. The message names the file and the class or function.
        DamagedPickleError: if the file is empty, truncated or no pickle.
        FileNotFoundError: if there is no such file.
        OSError: if it is a pipe or device, or larger than 256 MB.

    Examples:
        >>> import os, pickle, tempfile
        >>> import numpy as np
        >>> from torchrl_koap.data import UnsafePickleError, load_pickle
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = os.path.join(folder, "episode.pkl")
        ...     with open(path, "wb") as file:
        ...         pickle.dump({"robot": {"c_pos": np.arange(6.0).reshape(2, 3)}}, file)
        ...     load_pickle(path)["robot"]["c_pos"]
        array([[0., 1., 2.],
               [3., 4., 5.]])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = os.path.join(folder, "hostile.pkl")
        ...     with open(path, "wb") as file:
        ...         pickle.dump(print, file)
        ...     try:
        ...         load_pickle(path)
        ...     except UnsafePickleError as error:
        ...         "builtins.print" in str(error)
        True
    """
    path = Path(path)
    return loads_pickle(read_bytes(path), name=str(path))


def loads_pickle(content: bytes, *, name: str = "<bytes>") -> Any:
    """Reads a pickle from bytes under the rules of :func:`load_pickle`.

    Args:
        content (bytes): the pickle.
        name (str): what to call it in error messages.

    Returns:
        object: what the bytes hold: dicts, lists, strings, numbers and NumPy arrays.

    Raises:
        UnsafePickleError: see :func:`load_pickle`.
        DamagedPickleError: see :func:`load_pickle`.

    Examples:
        >>> import pickle
        >>> from torchrl_koap.data.d3il.unpickling import loads_pickle
        >>> loads_pickle(pickle.dumps([1, "two", None]))
        [1, 'two', None]
    """
    if not content:
        raise DamagedPickleError(f"{name}: the file is empty")
    scan(content, name, _STAND_INS)
    try:
        loaded = _RestrictedUnpickler(content, name).load()
        return _finish(loaded, name, depth=0, finished={}, open_containers=set())
    except UnsafePickleError:
        raise
    except RecursionError:
        raise UnsafePickleError(f"{name}: containers are nested too deeply") from None
    # a damaged pickle program can fail in as many ways as a damaged Python program
    except Exception as error:
        raise DamagedPickleError(f"{name}: not a complete pickle ({type(error).__name__}: {error})") from error


class _RestrictedUnpickler(pickle.Unpickler):
    def __init__(self, content: bytes, name: str):
        super().__init__(io.BytesIO(content), encoding="latin1")  # numpy data pickled by Python 2 are latin1 text
        self._name = name

    def find_class(self, module, attribute):
        if (module, attribute) not in _STAND_INS:
            raise refusal(self._name, spell(module, attribute))
        return _StandIn(f"{module}.{attribute}", _STAND_INS[module, attribute], self._name)

    def persistent_load(self, pid):
        raise refusal(self._name, f"data outside the file (persistent id {pid!r})")


class _StandIn:
    """Takes the place of a class or function; can be called, and cannot be changed by the file."""

    __slots__ = ("_build", "_file", "name")

    def __init__(self, name, build, file):
        self.name, self._build, self._file = name, build, file

    def __call__(self, *args):
        try:
            return self._build(*args)
        except UnsafePickleError as error:
            raise UnsafePickleError(f"{self._file}: {error}") from None

    def __setstate__(self, state):
        raise UnsafePickleError(f"{self._file}: tries to change {self.name}")


class _ElementType:
    """What ``numpy.dtype`` would be: the type of the elements of an array."""

    __slots__ = ("dtype",)

    def __init__(self, code, align=False, copy=False):
        if not isinstance(code, str) or not _ELEMENT_TYPES.fullmatch(code):
            raise UnsafePickleError(f"arrays of element type {code!r} are refused; only numbers and text are read")
        self.dtype = np.dtype(code)

    def __setstate__(self, state):
        byte_order, *structure = state[1:5]
        if any(part is not None for part in structure):
            raise UnsafePickleError("structured element types are refused; only plain arrays are read")
        if byte_order in ("<", ">"):
            self.dtype = self.dtype.newbyteorder(byte_order)
        elif byte_order not in ("|", "="):
            raise ValueError(f"byte order {byte_order!r}")


class _Array:
    """What ``numpy.ndarray`` would be until its state is set."""

    __slots__ = ("value",)

    def __init__(self):
        self.value = None

    def __setstate__(self, state):
        _, shape, element_type, column_major, content = state
        if isinstance(content, list):
            raise UnsafePickleError("arrays of objects are refused; only numbers and text are read")
        self.value = _view(content, element_type, shape, "F" if column_major else "C")


def _view(content, element_type, shape, order) -> np.ndarray:
    if isinstance(content, str):
        content = content.encode("latin1")
    if not isinstance(element_type, _ElementType) or not isinstance(content, (bytes, bytearray)):
        raise UnsafePickleError("an array is not made of bytes and a numpy element type")
    if not isinstance(shape, tuple) or not all(type(size) is int and size >= 0 for size in shape):
        raise ValueError(f"array shape {shape!r}")
    needed = math.prod(shape) * element_type.dtype.itemsize
    if needed != len(content):
        raise ValueError(f"an array of shape {shape} needs {needed} bytes, the file holds {len(content)}")
    array = np.frombuffer(content, element_type.dtype).reshape(shape, order=order)
    array.flags.writeable = False
    return array


def _is(stand_in, attribute) -> bool:
    return isinstance(stand_in, _StandIn) and stand_in.name.endswith(attribute)


def _reconstruct(array_class, shape, code):
    if not _is(array_class, "numpy.ndarray"):
        raise UnsafePickleError("only plain numpy arrays are read, not subclasses of them")
    return _Array()


def _from_buffer(content, element_type, shape, order, *_axis_order):
    if order not in ("C", "F") or _axis_order:
        raise ValueError(f"array order {order!r}")
    array = _Array()
    array.value = _view(content, element_type, shape, order)
    return array


def _scalar(element_type, content):
    return _view(content, element_type, (), "C")[()]


def _encode(text, encoding):
    if not isinstance(text, str) or encoding != "latin1":
        raise UnsafePickleError(f"encoding {encoding!r} is refused")
    return text.encode("latin1")


def _ordered_dict(*pairs):
    if pairs and len(pairs[0]) > MOST_ODD_KEYS:
        raise UnsafePickleError(f"a dictionary is made of {len(pairs[0]):,} pairs, more than {MOST_ODD_KEYS:,}")
    return dict(*pairs)


def _no_call(*_args):
    raise UnsafePickleError("calls numpy.ndarray directly")


def _empty_bytes():
    return b""


_STAND_INS = {
    ("numpy", "ndarray"): _no_call,
    ("numpy", "dtype"): _ElementType,
    ("collections", "OrderedDict"): _ordered_dict,
    ("_codecs", "encode"): _encode,
    ("builtins", "bytes"): _empty_bytes,
    ("__builtin__", "bytes"): _empty_bytes,
}
for _core in ("numpy.core", "numpy._core"):  # numpy 1.x and 2.x
    _STAND_INS[f"{_core}.multiarray", "_reconstruct"] = _reconstruct
    _STAND_INS[f"{_core}.multiarray", "scalar"] = _scalar
    _STAND_INS[f"{_core}.numeric", "_frombuffer"] = _from_buffer


def _finish(value, name: str, *, depth: int, finished: dict, open_containers: set) -> Any:
    """Puts the arrays in the place of their stand-ins and refuses what is left of the others."""
    if isinstance(value, _PLAIN) or isinstance(value, np.generic):
        return value
    if id(value) in finished:  # shared containers stay shared, and are visited once
        return finished[id(value)]
    if id(value) in open_containers:
        raise UnsafePickleError(f"{name}: a container holds itself")
    if depth > _MAX_DEPTH:
        raise UnsafePickleError(f"{name}: containers are nested more than {_MAX_DEPTH} deep")
    open_containers.add(id(value))
    finish = functools.partial(_finish, name=name, depth=depth + 1, finished=finished, open_containers=open_containers)
    if isinstance(value, _Array) and value.value is not None:
        result = value.value
    elif isinstance(value, _ElementType):
        result = value.dtype
    elif type(value) is dict:
        for key, entry in value.items():
            if not isinstance(key, (*_PLAIN, np.generic, tuple)):
                raise UnsafePickleError(f"{name}: a {type(key).__name__} is refused as a dictionary key")
            value[key] = finish(entry)
        result = value
    elif type(value) is list:
        value[:] = [finish(entry) for entry in value]
        result = value
    elif type(value) is tuple:
        result = tuple(finish(entry) for entry in value)
    elif type(value) is bytearray:
        result = bytes(value)
    else:
        kind = value.name if isinstance(value, _StandIn) else type(value).__name__
        raise refusal(name, f"{kind} as a value")
    open_containers.discard(id(value))
    finished[id(value)] = result
    return result
