# This source code is licensed under the MIT license found in the LICENSE file.
"""Classifies columns of recordings by name (clock, episode, action, ...) and converts their content to numbers."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from torchrl_koap.files import some

_NUMBERED = "(_?(id|uuid|idx|index|number|num|nr|no|name|key))?"
_ONE = (
    "(episode|ep|traj|trajectory|demo|demonstration|run|rollout|trial|segment|take|session|attempt|recording|sequence"
    "|video|bag|file)"
)
_END = (
    "(timeout|terminal|termination|terminated|truncation|truncated|done|last|finished|final|end)(_(step|frame|flag))?"
)
_WHOSE = "(sim|wall|ros|unix|system|log|elapsed|robot|host|device|sensor|camera|local|relative|record(ing)?|epoch)"
# names of columns that are no state: words joined by _, in lower case, without unit
_KINDS = {
    "clock": rf"t|(.+_)?(ts|time_?stamps?|stamps?)|({_WHOSE}_)?times?|elapsed|epoch|(date|up)_?time"
    r"|clock|utc|zeit|temps",
    "episode": rf"{_ONE}s?{_NUMBERED}",
    "end": rf"(is_)?{_END}s?(_float)?|{_ONE}_{_END}s?|(end_of|eo)_?({_ONE}|e)",
    "start": rf"(is_)?(first|start|begin|reset)(_(step|frame|flag))?|{_ONE}_(first|starts?|begins?)|new_{_ONE}",
    "length": rf"lengths|{_ONE}_len(gth)?s?",
    "frame": rf"(frame|step|time_?step)s?{_NUMBERED}",
    "other": r"index|task_index|row|_*index_level_0_*|unnamed:_0|(.+_)?(rewards?|success)(_(rate|flag))?"
    r"|infos_.+|rew|returns?(_to_go)?|discounts?|costs?|scores?|dt|delta_time",
}
_KIND = {kind: re.compile(pattern) for kind, pattern in _KINDS.items()}
_ACTING = re.compile(r"actions?(\d*|[^a-z\d].*)", re.IGNORECASE)
_UNITS = {
    1.0: "s sec secs seconds",
    1e-3: "ms msec msecs millis milliseconds",
    1e-6: "us \u00b5s \u03bcs usec usecs micros microseconds",  # micro sign, Greek mu
}
_UNITS |= {1e-9: "ns nsec nsecs nanos nanosec nanosecs nanoseconds", 60.0: "min minutes"}
UNITS = {name: unit for unit, names in _UNITS.items() for name in names.split()}
_UNIT = re.compile(rf"(.+?)[ _.-]*[ _.(\[-]({'|'.join(UNITS)})[)\]]?")
_EXACT = 2**53  # float64 represents all integers up to this one
_WORDS = {"true": 1.0, "false": 0.0} | dict.fromkeys(("", "na", "n/a", "null", "none"), np.nan)


def numbered(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Returns the columns of a table ``[T]`` or ``[T, d]`` as float64, named ``name_0``, ``name_1``, ..."""
    table = np.asarray(values, dtype=np.float64)
    table = table.reshape(len(table), int(np.prod(table.shape[1:])))
    return {f"{name}_{index}": column for index, column in enumerate(table.T)}


def leaves(observations: Any, name: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Yields the arrays of nested dictionaries, by name, and tuples, by number, with joined names."""
    if isinstance(observations, Mapping):
        parts = [(key, observations[key]) for key in sorted(observations)]
    elif isinstance(observations, tuple):
        parts = list(enumerate(observations))
    else:
        yield name, np.asarray(observations)
        return
    for key, part in parts:
        yield from leaves(part, f"{name}_{key}" if name else str(key))


def spread(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Returns the columns of a table ``[T]`` or ``[T, d]`` as float64, numbered if there are several."""
    columns = numbered(name, values)
    return {name: columns[f"{name}_0"]} if len(columns) == 1 else columns


def named_twice(columns: Mapping[str, Any], more: Mapping[str, Any]) -> list[str]:
    """Returns a list with a message if an entry has a column that another one has, else an empty list."""
    both = sorted(columns.keys() & more.keys())
    return [f"two entries have a column {some(both)}: rename one of them"] if both else []


def kind_of(name: str) -> tuple[str | None, float]:
    """Returns a column's kind by its name, None for a state, and a clock's unit in seconds: 0.001 for "Time [ms]"."""
    plain = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name.strip()).lower().removeprefix("next.")
    if "sec" in plain and plain in UNITS:
        return "clock", UNITS[plain]
    unit = _UNIT.fullmatch(plain)
    if unit and _KIND["clock"].fullmatch(_joined(unit[1])):
        return "clock", UNITS[unit[2]]
    return next((kind for kind, pattern in _KIND.items() if pattern.fullmatch(_joined(plain))), None), 1.0


def names_unit(name: str) -> bool:
    """Checks whether the name of a clock ends with its unit: "timestamp_ms", "Time [s]"."""
    return _UNIT.fullmatch(name.strip().lower()) is not None


def is_action(name: str) -> bool:
    """Checks whether a column of a table is an action by its name: "action", "Action_0", "actions[1]"."""
    return _ACTING.fullmatch(name) is not None


def _joined(name: str) -> str:
    return re.sub(r"[\s./#-]+", "_", name).strip("_")


def as_numbers(name: str, values: np.ndarray) -> np.ndarray | None:
    """Converts a column ``[T]`` of any type to float64; None if it holds no numbers.

    Booleans become 0 and 1. Dates become times in the clock's unit. Names of episodes are numbered as they appear.
    """
    (kind, unit), held = kind_of(name), values.dtype.kind
    if held in "mM" and kind == "clock":
        since = values.astype("datetime64[ns]") - np.datetime64(0, "ns") if held == "M" else values
        return since / np.timedelta64(1, "s") / unit
    if kind == "episode" and held in "iu" and len(values) and np.abs(values.astype(np.float64)).max() > _EXACT:
        return np.unique(values, return_inverse=True)[1].astype(np.float64)
    if held in "fiub":
        return values.astype(np.float64)
    if held not in "SUO":
        return None
    plain = (value.decode(errors="replace") if isinstance(value, bytes) else value for value in values.tolist())
    texts = ["" if value is None else str(value) for value in plain]
    numbers = [number_of(text) for text in texts]
    known = [number for number in numbers if number is not None]
    if len(known) == len(numbers) and not (kind == "episode" and max(map(abs, known), default=0) > _EXACT):
        return np.array(known)
    if kind == "episode":
        order = {text: number for number, text in enumerate(dict.fromkeys(texts))}
        return np.array([order[text] for text in texts], dtype=np.float64)
    if kind != "clock" or known:
        return None
    try:
        with warnings.catch_warnings():  # NumPy converts time zones correctly, but warns
            warnings.simplefilter("ignore")
            return as_numbers(name, np.array(texts, dtype="datetime64[ns]"))
    except ValueError:
        return None


def number_of(text: str) -> float | None:
    """Converts text to a number: NaN if it is empty, 0 or 1 for a boolean, None if it is no number."""
    text = text.strip().lower()
    try:
        return _WORDS[text] if text in _WORDS else None if "_" in text else float(text)
    except ValueError:
        return None
