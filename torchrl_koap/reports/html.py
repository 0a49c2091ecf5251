# This source code is licensed under the MIT license found in the LICENSE file.
"""Pieces of the report's page: tables, tiles, numbers in words, and its style. Everything that comes in is escaped."""

from __future__ import annotations

import math
from collections.abc import Mapping
from html import escape
from typing import Any

STYLE = """
:root { color-scheme: light; --ink: #1f2328; --muted: #5b6470; --line: #dfe3e8; --pale: #f6f7f9; --blue: #1f6feb; }
* { box-sizing: border-box; }
body { margin: 0; color: var(--ink); background: #fff; font: 16px/1.5 system-ui, "Segoe UI", sans-serif; }
main { max-width: 62rem; margin: 0 auto; padding: 1.5rem 1rem 4rem; }
header { border-bottom: 1px solid var(--line); }
h1 { font-size: 1.6rem; margin: 0; } h2 { font-size: 1.2rem; margin: 2.2rem 0 .6rem; }
h3 { font-size: 1rem; margin: 1.2rem 0 .3rem; }
header p, .tile .note, figcaption, summary { color: var(--muted); } header p { margin: .2rem 0 .8rem; }
header p, code, pre { overflow-wrap: anywhere; } td { overflow-wrap: break-word; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(15rem, 1fr)); gap: .8rem; }
.tile { border: 1px solid var(--line); border-radius: 8px; padding: .7rem .9rem; break-inside: avoid; }
.tile .name { font-size: .85rem; } .tile .value { font-size: 1.7rem; font-weight: 600; line-height: 1.25; }
.tile .note { font-size: .85rem; } .tile svg { display: block; width: 100%; height: 16px; margin: .25rem 0; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .9rem; }
th, td { text-align: left; vertical-align: top; padding: .25rem .9rem .25rem 0; border-bottom: 1px solid var(--line); }
th { font-weight: 500; color: var(--muted); }
td > table { margin: -.25rem 0; } td > table tr:last-child > * { border-bottom: 0; }
.scroll { overflow-x: auto; }
figure { margin: 0 0 1.8rem; break-inside: avoid; } figure img, figure video { max-width: 100%; display: block; }
figure:not(.beside) img { width: 100%; }
figure h3 { color: var(--ink); margin: 0 0 .3rem; } figcaption { font-size: .92rem; max-width: 46rem; }
.account { display: flex; gap: 1rem 2.5rem; flex-wrap: wrap; } .account > div { flex: 1 1 18rem; }
.account > figure { flex: 1 1 24rem; }
.beside { display: flex; gap: 1.5rem; align-items: center; flex-wrap: wrap; }
.beside > a { flex: 0 1 27rem; } .beside > figcaption { flex: 1 1 16rem; }
pre { background: var(--pale); padding: .7rem .9rem; border-radius: 6px; white-space: pre-wrap; font-size: .85rem; }
code { background: var(--pale); padding: .05rem .3rem; border-radius: 4px; font-size: .87em; }
.warning { border-left: 4px solid #d9730d; background: #fff6ec; padding: .5rem .8rem; overflow-wrap: anywhere; }
.absent { color: var(--muted); font-size: .92rem; }
details { margin: .8rem 0; } summary { cursor: pointer; }
@media print { body { font-size: 10.5pt; } main { max-width: none; padding: 0; } h2, h3 { break-after: avoid; }
  .tiles { grid-template-columns: repeat(3, 1fr); } .beside > a { flex-basis: 45%; }
  figure img, figure:not(.beside) img { width: auto; max-height: 11cm; } .account > figure img { max-height: 9cm; } }
"""
_UNITS = {"_ms": "ms", "_mm": "mm", "_mrad": "mrad", "_hz": "Hz", "_seconds": "s"}
_SHARES = ("success", "stacked_1", "stacked_2", "stacked_3")
_PERCENT = {f"{name}_{part}" for name in _SHARES for part in ("rate", "low", "high")}
_PLAIN = {"seed", "mode"}
_WORDS = {
    "success_low": "success, 95 % from",
    "success_high": "success, 95 % to",
    "analysis_labels_read": "labels read for analysis only",
    "held_out_error_mm": "error on held-out labelled steps (mm)",
}
_MANY = 40


def number(value: Any) -> float | int | None:
    """The value if it is a finite number, else None.

    Examples:
        >>> from torchrl_koap.reports.html import number
        >>> number(0.5), number(True), number("0.5"), number(float("nan"))
        (0.5, None, None, None)
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        return None
    return value


def duration(seconds: float) -> str:
    """A time in words.

    Examples:
        >>> from torchrl_koap.reports.html import duration
        >>> duration(7.25), duration(132), duration(7322)
        ('7.2 s', '2 min 12 s', '2 h 2 min')
    """
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def show(value: Any, key: str = "") -> str:
    """A single value as escaped text.

    Examples:
        >>> from torchrl_koap.reports.html import show
        >>> show(12345), show(0.123456), show("<b>"), show(None), show(0.95, "success_rate")
        ('12,345', '0.1235', '&lt;b&gt;', '–', '95.0 %')
    """
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return str(value) if key in _PLAIN else f"{value:,}"
    if isinstance(value, float):
        if not math.isfinite(value):
            return "not a number" if math.isnan(value) else "infinite"
        return f"{100 * value:.1f} %" if key in _PERCENT else f"{value:.4g}"
    return escape(str(value))


def label(key: Any) -> str:
    """A key as words, with its unit, escaped.

    Examples:
        >>> from torchrl_koap.reports.html import label
        >>> label("plan_ms"), label("planner_parameters")
        ('plan (ms)', 'planner parameters')
    """
    key = str(key)
    if key in _WORDS:
        return escape(_WORDS[key])
    for ending, unit in _UNITS.items():
        if key.endswith(ending) and len(key) > len(ending):
            return escape(f"{key[: -len(ending)].replace('_', ' ')} ({unit})")
    return escape(key.replace("_", " "))


def definition(key: str, value: Any) -> str:
    """Any JSON value: mappings and lists of mappings become tables, short lists a line.

    Examples:
        >>> from torchrl_koap.reports.html import definition
        >>> definition("scores", [1, 2])
        '1, 2'
    """
    if isinstance(value, Mapping):
        return table(value)
    if isinstance(value, (list, tuple)):
        if value and all(isinstance(item, Mapping) for item in value):
            columns = list(dict.fromkeys(name for item in value for name in item))
            head = "".join(f"<th>{label(name)}</th>" for name in columns)
            rows = [[definition(name, item.get(name)) for name in columns] for item in value]
            body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
            return f'<div class="scroll"><table><tr>{head}</tr>{body}</table></div>'
        rest = f" … ({len(value)} in all)" if len(value) > _MANY else ""
        return ", ".join(definition(key, item) for item in value[:_MANY]) + rest if value else "none"
    return show(value, key)


def table(values: Mapping[str, Any]) -> str:
    """A mapping as a table with a row per key; nested ones become tables inside.

    Examples:
        >>> from torchrl_koap.reports.html import table
        >>> table({"a": {"b": 1}}).count("<table>")
        2
    """
    if not values:
        return "none"
    rows = [f"<tr><th>{label(key)}</th><td>{definition(str(key), value)}</td></tr>" for key, value in values.items()]
    return f"<table>{''.join(rows)}</table>"


def tile(name: str, value: str, note: str, extra: str = "") -> str:
    """A headline number; ``extra`` is markup made here, the other arguments are escaped."""
    name, value, note = escape(name), escape(value), escape(note)
    return (
        f'<div class="tile"><div class="name">{name}</div><div class="value">{value}</div>{extra}'
        f'<div class="note">{note}</div></div>'
    )


def interval_bar(value: float, low: float, high: float) -> str:
    """A share with its interval on a line from 0 to 100 %, as a drawing inside the page.

    Examples:
        >>> from torchrl_koap.reports.html import interval_bar
        >>> 'x="80.0"' in interval_bar(0.9, 0.8, 0.96)
        True
    """
    value, low, high = (100 * min(max(part, 0.0), 1.0) for part in (value, low, high))
    return (
        '<svg viewBox="0 0 100 8" preserveAspectRatio="none" role="img"><title>interval</title>'
        '<rect x="0" y="3.4" width="100" height="1.2" fill="#dfe3e8"/>'
        f'<rect x="{low:.1f}" y="2" width="{max(high - low, 0.4):.1f}" height="4" fill="#1f6feb" opacity="0.35"/>'
        f'<rect x="{min(value, 99.2) - 0.2:.1f}" y="0.5" width="0.8" height="7" fill="#1f6feb"/></svg>'
    )
