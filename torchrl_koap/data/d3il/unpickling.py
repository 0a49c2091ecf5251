# This source code is licensed under the MIT license found in the LICENSE file.
"""A restricted unpickler: numpy arrays and plain containers, nothing else.

A pickle is a program. Two checks keep it from running code:

1. Its instructions are *scanned* without executing them. Those that plain data never need are refused: extension codes,
   persistent ids, class instances.
2. It is loaded with *stand-ins* for numpy's constructors; any other class or function is refused by name. Stand-ins
   build views of the file's bytes, so a declared shape cannot allocate more memory than the file holds.
"""

from __future__ import annotations

import functools
import io
import math
import pickle
import pickletools
import re
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_koap.files import DataError, read_bytes

_MAX_DEPTH = 64
_ELEMENT_TYPES = re.compile(r"b1|[iu][1248]|f[248]|c8|c16|[SU][1-9]\d{0,5}")
_PLAIN = (str, bytes, bool, int, float, type(None))
_INSTRUCTIONS = frozenset(
    "PROTO FRAME STOP MARK NONE NEWTRUE NEWFALSE INT BININT BININT1 BININT2 LONG LONG1 LONG4 FLOAT BINFLOAT STRING"
    " BINSTRING SHORT_BINSTRING UNICODE SHORT_BINUNICODE BINUNICODE BINUNICODE8 BINBYTES SHORT_BINBYTES BINBYTES8"
    " BYTEARRAY8 EMPTY_LIST APPEND APPENDS LIST EMPTY_TUPLE TUPLE TUPLE1 TUPLE2 TUPLE3 EMPTY_DICT DICT SETITEM SETITEMS"
    " PUT BINPUT LONG_BINPUT MEMOIZE GET BINGET LONG_BINGET GLOBAL STACK_GLOBAL REDUCE BUILD".split()
)


class UnsafePickleError(DataError):
    """A pickle asks for something other than arrays and plain containers; none of its code was run."""


class _RefusedError(Exception):
    """A pickle asks for something that is refused."""


def load_pickle(path: str | Path) -> Any:
    """Reads a pickle that holds nothing but numpy arrays and plain containers.

    Arrays of numbers, booleans and text, written by numpy 1 or 2 with any protocol, become views of the file's bytes.

    Raises:
        UnsafePickleError: if the file holds anything else. The message names the file and the class or function.
        DataError: if the file is empty, truncated or no pickle.
        OSError: if there is no such file, or it is a pipe or device, or larger than 256 MB.
    """
    return loads_pickle(read_bytes(path), name=str(path))


def loads_pickle(content: bytes, *, name: str = "<bytes>") -> Any:
    """Reads a pickle from bytes under the rules of :func:`load_pickle`."""
    try:
        _scan(content)
        loaded = _RestrictedUnpickler(content).load()
        return _finish(loaded, depth=0, finished={}, open_containers=set())
    except _RefusedError as refused:
        raise UnsafePickleError(name, str(refused)) from None
    except RecursionError:
        raise UnsafePickleError(name, "containers are nested too deeply") from None
    # a damaged pickle may raise any exception
    except Exception as error:
        raise DataError(name, f"not a complete pickle ({str(error) or type(error).__name__})") from error


def _asks_for(what: str) -> _RefusedError:
    return _RefusedError(f"asks for {what}: refused, only numpy arrays and plain containers are read")


def _scan(content: bytes) -> None:
    """Refuses instructions that plain data do not need, and visible names of classes, without running anything."""
    refused: dict[str, None] = {}  # in the order of the file
    position, texts = 0, [""]
    try:
        for opcode, argument, position in pickletools.genops(content):
            texts += [argument] if isinstance(argument, str) else []
            if opcode.name in ("GLOBAL", "INST") and tuple(argument.split(" ", 1)) not in _STAND_INS:
                refused[_spelled(*argument.split(" ", 1))] = None
            elif opcode.name not in _INSTRUCTIONS:
                refused[f"pickle instruction {opcode.name} (after {' '.join(texts[-2:])})"] = None
            elif "PUT" in opcode.name and argument > position:  # the C unpickler allocates memory up to this slot
                refused[f"memory slot {argument}"] = None
    finally:
        if refused:
            raise _asks_for(", ".join(list(refused)[:6]))
    if position + 1 != len(content):
        raise ValueError(f"{len(content) - position - 1} bytes follow the end of the pickle")


def _spelled(module: str, attribute: str = "") -> str:
    return f"{module.replace('__builtin__', 'builtins')}.{attribute}"  # Python 2 called it __builtin__


class _RestrictedUnpickler(pickle.Unpickler):
    def __init__(self, content: bytes):
        super().__init__(io.BytesIO(content), encoding="latin1")  # numpy data pickled by Python 2 are latin1 text

    def find_class(self, module, attribute):
        if (module, attribute) not in _STAND_INS:
            raise _asks_for(_spelled(module, attribute))
        return _StandIn(f"{module}.{attribute}", _STAND_INS[module, attribute])


class _StandIn:
    """Callable that replaces a class or function; the file cannot change it."""

    __slots__ = ("_build", "name")

    def __init__(self, name, build):
        self.name, self._build = name, build

    def __call__(self, *args):
        return self._build(*args)

    def __setstate__(self, state):
        raise _RefusedError(f"tries to change {self.name}")


class _ElementType:
    """Stand-in for ``numpy.dtype``: the element type of an array."""

    __slots__ = ("dtype",)

    def __init__(self, code, align=False, copy=False):
        if not isinstance(code, str) or not _ELEMENT_TYPES.fullmatch(code):
            raise _RefusedError(f"arrays of element type {code!r} are refused; only numbers and text are read")
        self.dtype = np.dtype(code)

    def __setstate__(self, state):
        byte_order = state[1]  # the rest is for structured types, which are refused
        if byte_order in ("<", ">"):
            self.dtype = self.dtype.newbyteorder(byte_order)
        elif byte_order not in ("|", "="):
            raise ValueError(f"byte order {byte_order!r}")


class _Array:
    """Stand-in for ``numpy.ndarray`` until its state is set."""

    __slots__ = ("value",)

    def __init__(self):
        self.value = None

    def __setstate__(self, state):
        _, shape, element_type, column_major, content = state
        if isinstance(content, list):
            raise _RefusedError("arrays of objects are refused; only numbers and text are read")
        self.value = _view(content, element_type, shape, "F" if column_major else "C")


def _view(content, element_type, shape, order) -> np.ndarray:
    if isinstance(content, str):
        content = content.encode("latin1")
    if not isinstance(element_type, _ElementType) or not isinstance(content, (bytes, bytearray)):
        raise _RefusedError("an array is not made of bytes and a numpy element type")
    if not isinstance(shape, tuple) or not all(type(size) is int for size in shape):
        raise ValueError(f"array shape {shape!r}")
    needed = math.prod(shape) * element_type.dtype.itemsize
    if needed != len(content):
        raise ValueError(f"an array of shape {shape} needs {needed} bytes, the file holds {len(content)}")
    return np.frombuffer(content, element_type.dtype).reshape(shape, order=order)


def _reconstruct(array_class, shape, code):
    if not isinstance(array_class, _StandIn) or not array_class.name.endswith("numpy.ndarray"):
        raise _RefusedError("only plain numpy arrays are read, not subclasses of them")
    return _Array()


def _from_buffer(content, element_type, shape, order, *_axis_order):
    if order not in ("C", "F"):
        raise ValueError(f"array order {order!r}")
    array = _Array()
    array.value = _view(content, element_type, shape, order)
    return array


def _scalar(element_type, content):
    return _view(content, element_type, (), "C")[()]


def _encode(text, encoding):
    if not isinstance(text, str) or encoding != "latin1":
        raise _RefusedError(f"encoding {encoding!r} is refused")
    return text.encode("latin1")


def _no_call(*_args):
    raise _RefusedError("calls numpy.ndarray directly")


_STAND_INS = {
    ("numpy", "ndarray"): _no_call,
    ("numpy", "dtype"): _ElementType,
    ("collections", "OrderedDict"): dict,
    ("_codecs", "encode"): _encode,
    ("builtins", "bytes"): lambda: b"",
    ("__builtin__", "bytes"): lambda: b"",
}
for _core in ("numpy.core", "numpy._core"):  # numpy 1.x and 2.x
    _STAND_INS[f"{_core}.multiarray", "_reconstruct"] = _reconstruct
    _STAND_INS[f"{_core}.multiarray", "scalar"] = _scalar
    _STAND_INS[f"{_core}.numeric", "_frombuffer"] = _from_buffer


def _finish(value, *, depth: int, finished: dict, open_containers: set) -> Any:
    """Replaces array stand-ins by their arrays and refuses all other stand-ins."""
    if isinstance(value, _PLAIN) or isinstance(value, np.generic):
        return value
    if id(value) in finished:  # shared containers stay shared and are visited once
        return finished[id(value)]
    if id(value) in open_containers:
        raise _RefusedError("a container holds itself")
    if depth > _MAX_DEPTH:
        raise _RefusedError(f"containers are nested more than {_MAX_DEPTH} deep")
    open_containers.add(id(value))
    finish = functools.partial(_finish, depth=depth + 1, finished=finished, open_containers=open_containers)
    if isinstance(value, _Array) and value.value is not None:
        result = value.value
    elif type(value) is dict:
        for key, entry in value.items():
            if not isinstance(key, (*_PLAIN, np.generic, tuple)):
                raise _RefusedError(f"a {type(key).__name__} is refused as a dictionary key")
            value[key] = finish(entry)
        result = value
    elif type(value) is list:
        value[:] = [finish(entry) for entry in value]
        result = value
    elif type(value) is tuple:
        result = tuple(finish(entry) for entry in value)
    else:
        raise _asks_for(f"{value.name if isinstance(value, _StandIn) else type(value).__name__} as a value")
    finished[id(value)] = result
    return result
