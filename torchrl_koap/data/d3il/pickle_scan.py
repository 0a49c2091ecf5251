# This source code is licensed under the MIT license found in the LICENSE file.
"""A look through a pickle's instructions without executing them: the first gate of the restricted unpickler."""

from __future__ import annotations

import pickletools
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

_MOST_VALUES = 1_000_000  # values that a tuple unfolds to: so much is gone through when it is hashed
MOST_ODD_KEYS = 10_000  # keys other than text can be chosen to collide, which takes the square of their number

_STRINGS = frozenset("STRING BINSTRING SHORT_BINSTRING UNICODE SHORT_BINUNICODE BINUNICODE BINUNICODE8".split())
_REMEMBER = frozenset("PUT BINPUT LONG_BINPUT MEMOIZE".split())
_RECALL = frozenset("GET BINGET LONG_BINGET".split())
_TUPLES = frozenset("TUPLE TUPLE1 TUPLE2 TUPLE3".split())
_KEYED = frozenset("DICT SETITEM SETITEMS".split())
_PLAIN_OPCODES = (
    frozenset(
        "PROTO FRAME STOP MARK NONE NEWTRUE NEWFALSE INT BININT BININT1 BININT2 LONG LONG1 LONG4 FLOAT BINFLOAT"
        " BINBYTES SHORT_BINBYTES BINBYTES8 BYTEARRAY8 EMPTY_LIST APPEND APPENDS LIST EMPTY_TUPLE TUPLE TUPLE1 TUPLE2"
        " TUPLE3 EMPTY_DICT DICT SETITEM SETITEMS GLOBAL STACK_GLOBAL REDUCE BUILD".split()
    )
    | _STRINGS
    | _REMEMBER
    | _RECALL
)


class UnsafePickleError(ValueError):
    """The file asks for something other than arrays and plain containers; nothing of it was run."""


class DamagedPickleError(ValueError):
    """The file is empty, truncated, or not a pickle at all."""


class _Sketch(NamedTuple):
    """What the scan knows of a value without building it: its text, if it is one, and how many values it unfolds to."""

    text: str | None = None
    size: int = 1


def scan(content: bytes, name: str, permitted: Collection[tuple[str | None, str | None]]) -> None:
    """Refuses, without running anything, instructions, names and amounts of work that plain data do not need.

    Args:
        content (bytes): the pickle.
        name (str): what to call it in error messages.
        permitted (collection of tuple): module and attribute of the classes and functions that a file may ask for.

    Raises:
        UnsafePickleError: if it asks for anything else.
        DamagedPickleError: if it is no whole pickle.
    """
    refused: dict[str, None] = {}  # in the order they are met
    stack: list[_Sketch | None] = []  # None is a mark
    remembered: dict[int, _Sketch] = {}
    position, damage, odd_keys = 0, None, 0
    try:
        for opcode, argument, position in pickletools.genops(content):
            instruction, asked = opcode.name, None
            if instruction in _REMEMBER:
                slot = len(remembered) if instruction == "MEMOIZE" else argument
                if slot > position:  # the C unpickler allocates up to the largest slot at once
                    refused[f"memory slot {slot}"] = None
                remembered[slot] = stack[-1] or _Sketch()
            taken = [] if instruction in _REMEMBER else _take(stack, opcode.stack_before)
            if instruction in ("GLOBAL", "INST"):
                asked = tuple(argument.split(" ", 1))
            elif instruction == "STACK_GLOBAL":
                asked = tuple(value.text for value in taken)
            if asked is not None and asked not in permitted:
                refused["a disguised name" if None in asked else spell(*asked)] = None
            elif instruction not in _PLAIN_OPCODES:
                refused[f"pickle instruction {instruction}"] = None
            if instruction in _KEYED:
                keys = taken if instruction == "DICT" else taken[1:]
                odd_keys += sum(key.text is None for key in keys[::2])
            if instruction in _REMEMBER:
                continue
            if instruction == "MARK":
                stack.append(None)
            elif opcode.stack_after:
                sketch = remembered.get(argument, _Sketch()) if instruction in _RECALL else _Sketch()
                if instruction in _STRINGS:
                    sketch = _Sketch(argument)
                elif instruction in _TUPLES:
                    sketch = _Sketch(size=1 + sum(value.size for value in taken))
                if sketch.size > _MOST_VALUES:  # shared parts: a short file can unfold without end
                    refused[f"a tuple of more than {_MOST_VALUES:,} values"] = None
                    sketch = _Sketch()
                stack.append(sketch)
    except Exception as error:  # genops reports damage by several kinds of errors
        damage = f"{name}: not a complete pickle ({error or type(error).__name__}, after byte {position})"
    if odd_keys > MOST_ODD_KEYS:
        refused[f"{odd_keys:,} dictionary keys that are no text (more than {MOST_ODD_KEYS:,})"] = None
    if refused:
        raise refusal(name, ", ".join(list(refused)[:6]))
    if damage:
        raise DamagedPickleError(damage)
    if position + 1 != len(content):
        raise DamagedPickleError(f"{name}: {len(content) - position - 1} bytes follow the end of the pickle")


def _take(stack: list[_Sketch | None], before: Sequence[Any]) -> list[_Sketch]:
    """Takes from the sketched stack what an instruction uses up; first comes what was pushed first."""
    taken = []
    if pickletools.markobject in before:
        while (value := stack.pop()) is not None:
            taken.append(value)
        before = before[: before.index(pickletools.markobject)]
    for _ in before:
        value = stack.pop()
        if value is None:
            raise ValueError("a mark where a value was wanted")
        taken.append(value)
    return taken[::-1]


def refusal(name: str, asked: str) -> UnsafePickleError:
    """The error about what a file asks for.

    Args:
        name (str): what to call the file.
        asked (str): what it asks for.
    """
    return UnsafePickleError(f"{name}: asks for {asked}: refused, only numpy arrays and plain containers are read")


def spell(module: str, attribute: str) -> str:
    """The dotted name of a class or function.

    Args:
        module (str): its module, by the name of Python 2 or 3.
        attribute (str): its name there.
    """
    return f"{module.replace('__builtin__', 'builtins')}.{attribute}"  # Python 2 called it __builtin__
