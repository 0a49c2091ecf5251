# This source code is licensed under the MIT license found in the LICENSE file.
"""Writes a page per method of ``METHODS``: equation, data that it may read, parameters, losses, results."""

from __future__ import annotations

import inspect
import re
import textwrap
from functools import partial
from typing import Any

from pages import benchmark_rows, escape, heading, measured_table, table, toctree, write_page

from torchrl_koap.runs.config import TrainConfig
from torchrl_koap.tasks import get_task
from torchrl_koap.training.defaults import resolve
from torchrl_koap.training.method import Method
from torchrl_koap.training.methods import METHODS
from torchrl_koap.training.trained import build_networks

# for networks whose docstring has no equation; "paper" is the name of a preset
EQUATIONS = {
    "KoopmanInverseDynamics": (
        r"z_t = g(x_t), \quad u_t = f(x_{t-4:t}, x_{t+2:t+5}), \quad z_{t+1} = K z_t + B u_t, \quad a_t = D u_t"
    ),
    "paper": r"z_t = g(x_t), \quad u_t = f(x_{t-1}, x_t, x_{t+8}), \quad z_{t+1} = K z_t + u_t, \quad a_t = D u_t + b",
    "LinearInverseDynamics": r"a_t = W \, [x_{t-1}, x_t, x_{t+8}] + b",
    "DiffusionPolicy": r"p(a_{t:t+H} \mid x_{t-1}, x_t)",
}
WINDOWS = {
    "all": "all windows, labelled or not, as they come",
    "mixed": "all windows, 25 % of every batch labelled",
    "labelled": "labelled windows alone",
}


def setup(app: Any) -> dict[str, Any]:
    """Registers the extension with Sphinx."""
    app.connect("builder-inited", lambda app: write_method_pages())
    return {"parallel_read_safe": True}


def write_method_pages() -> None:
    """Writes ``generated/methods``: an index and a page per method."""
    for method in METHODS.values():
        write_method(method)
    rows = [
        (f":doc:`{method.name}`", escape(method.title), "controller" if method.plans else "policy")
        for method in METHODS.values()
    ]
    write_page(
        "methods/index",
        heading("Every method in numbers"),
        "Made from ``torchrl_koap/training/methods.py``, where a method is one entry. Why these are compared: "
        ":doc:`/methods`.",
        table(("``--method``", "what it is", "kind"), rows),
        toctree(METHODS, hidden=True),
    )


def write_method(method: Method) -> None:
    """Writes the page of one method."""
    network = build(method, "avoiding")
    kind = type(network)
    sizes = {task: sum(p.numel() for p in build(method, task).parameters()) for task in ("avoiding", "stacking")}
    facts = [
        ("network", f":class:`~{kind.__module__}.{kind.__name__}`"),
        ("planner", "the one that all controllers share" if method.plans else "none: it samples actions"),
        *frames_read(network),
        ("states it learns from", states_seen(method)),
        ("decoder", "closed form, on every labelled step once" if method.closed_form else "trained by gradients"),
        ("parameters, Avoiding and Stacking", f"{sizes['avoiding']:,} and {sizes['stacking']:,}"),
    ]
    if method.teacher:
        facts.append(("the rest of the data is labelled by", f":doc:`{method.teacher}`"))
    write_page(
        f"methods/{method.name}",
        heading(method.name),
        f"{escape(method.title)}. {(kind.__doc__ or '').strip().splitlines()[0]}",
        equation(method, kind),
        table(("fact", "value"), facts),
        heading("How it is trained", 1),
        phases(method),
        heading("Measured", 1),
        measured(method),
    )


def build(method: Method, task_name: str) -> Any:
    """Builds the untrained network as ``koap train`` does."""
    task = get_task(task_name)
    return build_networks(task, resolve(TrainConfig(out="unused", method=method.name), task))[1]


def equation(method: Method, kind: type) -> str:
    """Returns the equation of the network's docstring, or else that of ``EQUATIONS``."""
    found = re.search(r"^\.\. math::\n((?:[ \t]+\S.*\n|\s*\n)+)", (inspect.getdoc(kind) or "") + "\n", re.MULTILINE)
    if found:
        return f".. math::\n\n{textwrap.indent(textwrap.dedent(found[1]).strip(), '   ')}"
    text = EQUATIONS.get(method.presets[0]) or EQUATIONS.get(kind.__name__)
    return f".. math::\n\n   {text}" if text else ""


def frames_read(network: Any) -> list[tuple[str, str]]:
    """Returns a row with the number of frames that the network reads, if it declares that."""
    past, frames = getattr(network, "num_past", None), getattr(network, "num_window_frames", None)
    if past is None or frames is None:
        return []
    return [("frames read for one action", f"{past} before the present one, {max(frames - past - 1, 0)} after it")]


def states_seen(method: Method) -> str:
    """Describes the states that the method may learn from."""
    if method.sees == "labelled":
        return "those of labelled windows, statistics included"
    if not method.phases:
        return "none but their statistics: nothing is trained"
    kinds = {phase.windows for phase in method.phases}
    return "labelled ones; of the others only the statistics" if kinds == {"labelled"} else "all, labelled or not"


def phases(method: Method) -> str:
    """Returns a table of the method's phases, losses and windows."""
    rows = []
    for phase in method.phases:
        loss = phase.loss.func if isinstance(phase.loss, partial) else phase.loss
        role = "class" if isinstance(loss, type) else "func"
        rows.append(
            (phase.name, f":{role}:`~{loss.__module__}.{loss.__name__}`", WINDOWS[phase.windows], f"{phase.share:.0%}")
        )
    return table(("phase", "loss", "windows", "share of the updates"), rows) or "Nothing is trained by gradients."


def measured(method: Method) -> str:
    """Returns a table of the method's success in the current comparison."""
    return measured_table(benchmark_rows(method=method.name), "task") or "Not in the current comparison."
