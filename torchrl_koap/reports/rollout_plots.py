# This source code is licensed under the MIT license found in the LICENSE file.
"""Pictures of rollouts: the modes that occurred, paths over the scene from above, and plans against execution."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import CSS4_COLORS, hsv_to_rgb, rgb_to_hsv, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from safetensors.numpy import load_file

from torchrl_koap.evaluation.statistics import expected_entropy, mode_entropy
from torchrl_koap.lookup import resolve
from torchrl_koap.reports.pictures import NothingToDraw, picture
from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.reports.scenes import (
    bodies_of,
    body_handles,
    body_paths,
    draw_bodies,
    draw_failure_end,
    draw_scene,
    keep_inside,
    read_episodes,
)
from torchrl_koap.reports.style import (
    BLUE,
    FAILURE_MARKS,
    GREY,
    INK,
    MUTED,
    OUTCOMES,
    SUCCESS,
    entry,
    panels,
    put_legend,
    set_title,
    shorten,
    tidy,
    with_unit,
)
from torchrl_koap.tasks import Modes
from torchrl_koap.tasks.columns import thousandths

_LISTED = 10  # up to this many modes of a single choice, bars are wide and have names below


@picture(
    "modes.png",
    source="rollouts.safetensors",
    title="Modes of the successful rollouts",
    caption="One bar per mode, in the colour of its rollouts. Black ticks: the share of each mode in the"
    " demonstrations, if their modes are known. Entropy is 1 if all modes are equally frequent; a few rollouts cannot"
    " reach 1 even with a uniform choice: the title gives its mean value.",
    order=40,
)
def draw_modes(rollouts: Mapping[str, Any], run: RunFacts) -> Figure:
    """Draws how often each ``mode`` ``[E]`` occurred among the successes, with the entropy of the distribution.

    The title counts those without one (-1); modes of the demonstrations are ticks, scaled to the number of rollouts.
    """
    modes, number = run.modes, run.modes.number
    if number < 2:
        raise NothingToDraw("the task has only one mode")
    mode = entry(rollouts, "mode", [None]).astype(int)
    mode = mode[entry(rollouts, "outcome", [len(mode)]) == SUCCESS]
    lost = int(((mode < 0) | (mode >= number)).sum())
    mode = mode[(mode >= 0) & (mode < number)]
    counts = np.bincount(mode, minlength=number)
    *heads, (last, names) = modes.choices
    places = np.arange(number) + (0.7 * (np.arange(number) // len(names)) if heads else 0.0)

    few = not heads and number <= _LISTED
    figure = Figure(figsize=(max(5.6, 0.85 * number + 1.2) if few else 8.4, 3.3), layout="constrained")
    axes = figure.add_subplot()
    axes.bar(places, counts, width=0.86, color=mode_colors(modes), zorder=2)
    reference = recorded_modes(run.folder / "demonstrations.safetensors", modes)
    if len(reference):
        level = np.bincount(reference, minlength=number) * len(mode) / len(reference)
        label = f"{len(reference)} demonstrations, scaled"
        axes.hlines(level, places - 0.46, places + 0.46, color=INK, linewidth=1.3, zorder=3, label=label)
        put_legend(axes)
    axes.set_ylabel("successful rollouts")
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.set_ylim(0, 1.2 * max(1, axes.dataLim.y1))
    axes.set_xlim(places[0] - 0.8, places[-1] + 0.8)
    if heads:
        axes.set_xticks(places, [name.split()[-1] for name in names] * (number // len(names)))
        for group in range(number // len(names)):
            middle = places[group * len(names) : (group + 1) * len(names)].mean()
            text = Modes(modes.choices[:-1]).name_of(group).replace(", ", " / ")  # all choices except the last
            axes.annotate(text, (middle, 0), (0, -22), textcoords="offset points", ha="center", size=8.5, color=INK)
        axes.set_xlabel(" / ".join(name for name, _ in heads) + f", and above it {last}", labelpad=19)
    else:
        axes.set_xticks(places, [name.replace(", ", "\n") for name in names])
        axes.set_xlabel(last)
    occurred = f"{int((counts > 0).sum())} of {number} modes, entropy {mode_entropy(mode.tolist(), number):.2f}"
    uniform = f"a uniform choice gives {expected_entropy(len(mode), number):.2f} on average at n = {len(mode)}"
    parts = [occurred] + [uniform] * bool(len(mode)) + [f"{lost} without a mode"] * bool(lost)
    tidy(axes, ";\n".join((parts[0], "; ".join(parts[1:]))) if few and parts[1:] else "; ".join(parts))
    axes.tick_params(axis="x", length=0)
    return figure


def recorded_modes(demonstrations: Path, modes: Modes) -> np.ndarray:
    """Returns the decided modes of the demonstrations; none if the task does not derive modes from paths.

    The file holds ``position`` ``[N, 2]`` (m) and ``episode`` ``[N]``.
    """
    mode_of_path = resolve(modes.of_path, "of_path of the modes")
    data = load_file(demonstrations) if demonstrations.exists() else {}
    if mode_of_path is None or "position" not in data:
        return np.zeros(0, int)
    position = entry(data, "position", [None, 2])
    episode = entry(data, "episode", [len(position)])
    paths = np.split(position, np.flatnonzero(np.diff(episode) != 0) + 1)
    found = np.array([mode_of_path(path) for path in paths], int)
    return found[(found >= 0) & (found < modes.number)]


def mode_colors(modes: Modes) -> np.ndarray:
    """Returns an sRGB colour in 0..1 for each mode: hue stands for the last choice, lightness for all before it.

    Choices that are named after colours have their hues.
    """
    if modes.number < 2:
        return np.array([to_rgb(BLUE)])
    names = modes.choices[-1][1]
    hues = len(names)
    shades = modes.number // hues
    if all(name in CSS4_COLORS for name in names):
        hue = np.tile(rgb_to_hsv([to_rgb(name) for name in names])[:, 0], shades)
    else:
        hue = np.tile((0.6 - np.arange(hues) * min(0.27, 1 / hues)) % 1, shades)
    if shades > 1:
        lightness = np.repeat(np.linspace(0.42, 1.3, shades), hues)
    else:  # neighbours among many hues must also differ in lightness
        lightness = np.where(np.arange(hues) % 2, 0.8 if hues <= 8 else 1.15, 0.8)
    pure = hsv_to_rgb(np.stack([hue, np.full_like(hue, 0.8), np.minimum(lightness, 0.95)], 1))
    return 1 - (1 - pure) * np.clip(2 - lightness, 0, 1)[:, None]


def episode_colors(mode: np.ndarray, outcome: np.ndarray, modes: Modes) -> list[Any]:
    """Returns the colour of each episode by mode and outcome ``[E]``: failures are black, undecided successes grey."""
    known = dict(enumerate(mode_colors(modes)))
    return [known.get(int(one), GREY) if kind == SUCCESS else INK for one, kind in zip(mode, outcome, strict=True)]


def _rollouts_caption(run: RunFacts) -> str:
    modes = "; a colour per mode, as in their chart below" if run.modes.number > 1 else ""
    cross = "a cross (collision) or " if run.evaluation.get("collisions") else ""
    return (
        f"Path of the tool centre from above, to scale{modes}. Failures are black and end in {cross}a square (out of"
        f" time).{'' if run.task is None else run.task.scene.caption}"
    )


@picture("rollouts.png", source="rollouts.safetensors", title="Executed rollouts", caption=_rollouts_caption, order=10)
def draw_rollouts(rollouts: Mapping[str, Any], run: RunFacts) -> Figure:
    """Draws executed paths over the scene, coloured by mode; failures are black with a mark at the end.

    For tasks with bodies, a second panel shows their starts, paths and ends.

    Entries: ``position`` ``[E, T, 2]`` (m, NaN after the end), ``length``, ``mode`` (-1 none) and ``outcome`` (0 out of
    time, 1 success, 2 collision) ``[E]``; optionally ``object_position`` ``[E, T, bodies, 2]`` (m) and ``context``
    ``[E, bodies, 3]`` (x, y in m, yaw in rad).
    """
    if run.offline:
        raise NothingToDraw("it is not known which columns are planar positions")
    paths, mode, outcome = read_episodes(rollouts)
    bodies, colors = body_paths(rollouts), episode_colors(mode, outcome, run.modes)
    good, crowded = outcome == SUCCESS, sum(map(len, paths)) > 8000
    figure = Figure(figsize=(9.4 if bodies else 6.2, 5.9), layout="constrained")
    axes, *beside = figure.subplots(1, 2 if bodies else 1, squeeze=False, sharex=True, sharey=True)[0]
    draw_scene(axes, run.task)
    axes.add_collection(
        LineCollection(
            [paths[index] for index in np.flatnonzero(good)],
            colors=[colors[index] for index in np.flatnonzero(good)],
            linewidths=0.6 if crowded else 1.1,
            alpha=0.55 if crowded else 0.85,
            zorder=2,
        )
    )
    for index in np.flatnonzero(~good):
        axes.plot(*paths[index].T, color=colors[index], linewidth=1.2, zorder=4)
        draw_failure_end(axes, paths[index], outcome[index])
    keep_inside(axes, paths)
    ends = [kind for kind in FAILURE_MARKS if (outcome == kind).any()]
    counts = [f"{int(good.sum())} of {len(good)} rollouts succeed"]
    counts += [f"{OUTCOMES[kind]}: {int((outcome == kind).sum())}" for kind in ends]
    set_title(axes, ", ".join(counts))
    marks = [
        Line2D([], [], color=INK, linewidth=1.2, marker=FAILURE_MARKS[kind], markersize=7, label=OUTCOMES[kind])
        for kind in ends
    ]
    for panel in beside:
        draw_bodies(draw_scene(panel, run.task), bodies, run.task, good, rollouts.get("context"))
        panel.label_outer()
        set_title(panel, "objects: starts (pale), paths, ends")
        marks += body_handles(bodies_of(run.task, bodies[0].shape[1]), good)
    if marks:
        put_legend([axes, *beside][-1], handles=marks)
    return figure


def _plans_caption(run: RunFacts) -> str:
    if run.offline:
        return (
            "Wide line: executed states, grey in a failure. Thin lines: every plan of that episode, from the step"
            " after it was made. Shown are at most six columns that actions move. Failures come first."
        )
    objects = " Outlines and thin coloured lines are the objects of that episode: starts and paths."
    return (
        "Wide pale band: the executed path. Thin lines: every plan of that episode; dots: where each was made. A plan"
        " that leaves the band at once was not followed (the controller errs); plans that fan out at their ends were"
        " followed, then replaced (the planner revises). Distances are to the nearest point of the path at any time;"
        " planned points beyond its end do not count. Failures come first."
    ) + (objects if run.task is not None and run.task.bodies else "")


@picture(
    "plans.png",
    source="rollouts.safetensors",
    title="Plans against execution",
    caption=_plans_caption,
    order=50,
    empty="the rollouts hold no plans of positions",
)
def draw_plans(rollouts: Mapping[str, Any], run: RunFacts) -> Figure:
    """Draws every plan of a few episodes over the executed path.

    Shown are up to two failures, then successes of as many different modes as possible, six in all. Entries as for
    :func:`draw_rollouts`, with ``plan`` ``[E, P, H, 2]`` (m, NaN padded) and ``plan_step`` ``[E, P]``, the control step
    at which each plan was made (-1 padding).
    """
    if run.offline:
        return _draw_plans_over_time(rollouts, run)
    paths, mode, outcome = read_episodes(rollouts)
    plan = entry(rollouts, "plan", [len(paths), None, None, 2])
    if not plan.shape[1]:
        raise NothingToDraw("the rollouts hold no plans of positions")
    plan_step = entry(rollouts, "plan_step", plan.shape[:2])
    colors, bodies = episode_colors(mode, outcome, run.modes), body_paths(rollouts)
    episodes = choose_episodes(mode, outcome, 6)
    figure, drawn = panels(len(episodes), 3, (4.4, 4.25), (0.3, 0.3))
    for axes, index in zip(drawn, episodes, strict=True):
        path, won = paths[index], outcome[index] == SUCCESS
        draw_scene(axes, run.task)
        if bodies:
            context = rollouts["context"][index : index + 1] if "context" in rollouts else None
            draw_bodies(axes, bodies[index : index + 1], run.task, [won], context)
        axes.plot(*path.T, color=colors[index], linewidth=5, alpha=0.4, zorder=2, solid_capstyle="round")
        made = np.flatnonzero(plan_step[index] >= 0)
        lines = [points[np.isfinite(points).all(1)] for points in plan[index, made]]
        axes.add_collection(LineCollection(lines, colors=[INK], linewidths=0.6, zorder=3))
        starts = plan_step[index, made]
        axes.scatter(*path[starts[starts < len(path)]].T, s=5, color=INK, linewidths=0, zorder=4)
        if not won:
            draw_failure_end(axes, path, outcome[index])
        keep_inside(axes, [path, *lines])
        stray = plan_deviation(path, lines)
        note = "no plan within the path"
        if len(stray):
            unit, factor = thousandths("m")
            middle, most = factor * np.quantile(stray, [0.5, 0.95])
            note = f"off the path: median {middle:.1f}, 95 % within {most:.1f} {unit}"
        what = OUTCOMES[outcome[index]]
        if won and run.modes.number > 1:
            what = run.modes.name_of(int(mode[index]))
        set_title(axes, f"episode {index}: {what}\n{note}")
    return figure


def _draw_plans_over_time(rollouts: Mapping[str, Any], run: RunFacts) -> Figure:
    """Draws executed states and every plan of up to three episodes, a panel per column that actions move."""
    assert run.task is not None
    length, outcome = (entry(rollouts, name, [None]).astype(int) for name in ("length", "outcome"))
    columns = entry(rollouts, "column", [None]).astype(int)
    state = entry(rollouts, "state", [len(length), None, len(columns)])
    plan = entry(rollouts, "state_plan", [len(length), None, None, len(columns)])
    if not plan.shape[1]:
        raise NothingToDraw("the rollouts hold no plans")
    plan_step = entry(rollouts, "plan_step", plan.shape[:2])
    episodes = choose_episodes(np.full(len(length), -1), outcome, 3)
    figure = Figure(figsize=(3.8 * len(episodes) + 0.3, 1.9 * len(columns) + 0.5), layout="constrained")
    grid = figure.subplots(len(columns), len(episodes), squeeze=False, sharex="col", sharey="row")
    for index, down in zip(episodes, grid.T, strict=True):
        made = np.flatnonzero(plan_step[index] >= 0)
        steps = plan_step[index, made, None] + 1 + np.arange(plan.shape[2])
        for place, (axes, column) in enumerate(zip(down, columns, strict=True)):
            lines = np.stack([steps, plan[index, made, :, place]], -1)
            axes.add_collection(LineCollection(list(lines), colors=[INK], linewidths=0.5, alpha=0.6, zorder=3))
            color = BLUE if outcome[index] == SUCCESS else MUTED
            axes.plot(state[index, : length[index] + 1, place], color=color, linewidth=4, alpha=0.5, zorder=2)
            axes.autoscale_view()
            if index == episodes[0]:
                axes.set_ylabel(with_unit(shorten(run.task.state_names[column]), run.task.state_units[column]))
            tidy(axes)
        set_title(down[0], f"episode {index}: {OUTCOMES[outcome[index]]}")
        down[-1].set_xlabel("control step")
        down[-1].xaxis.set_major_locator(MaxNLocator(6, integer=True))
    return figure


def choose_episodes(mode: np.ndarray, outcome: np.ndarray, count: int) -> list[int]:
    """Chooses episodes to show: two failures, then a success of each mode, then others.

    Modes (-1: none) and outcomes are those of every episode, int ``[E]``. Returns the indices of at most ``count``.
    """
    bad = np.flatnonzero(outcome != SUCCESS).tolist()
    chosen, spare = bad[: min(2, count)], bad[2:]
    good = np.flatnonzero(outcome == SUCCESS)
    firsts = [int(good[mode[good] == value][0]) for value in np.unique(mode[good])]
    room = count - len(chosen)
    if len(firsts) > room:
        firsts = [firsts[int(index)] for index in np.linspace(0, len(firsts) - 1, room).round()]
    rest = [int(index) for index in good if index not in firsts]
    return chosen + (firsts + rest + spare)[:room]


def plan_deviation(path: np.ndarray, plans: Sequence[np.ndarray]) -> np.ndarray:
    """Returns the distances (m) of planned points ``[H, 2]`` from the executed path ``[L, 2]`` at any time.

    Points planned beyond the path's end are left out: nothing was executed there.
    """
    points = np.concatenate([np.zeros((0, 2)), *plans])
    if len(path) < 2 or not len(points):
        return np.zeros(0)
    start, along = path[:-1], np.diff(path, axis=0)
    square = np.maximum(np.square(along).sum(1), 1e-18)
    offset = points[:, None] - start  # [points, L-1, 2]
    share = (offset * along).sum(-1) / square
    distance = np.linalg.norm(offset - np.clip(share, 0, 1)[..., None] * along, axis=-1)
    nearest = distance.argmin(1)
    beyond = (nearest == len(along) - 1) & (share[:, -1] > 1)
    return distance.min(1)[~beyond]
