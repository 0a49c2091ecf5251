# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests plots of modes, executed paths, plans and bodies."""

import math
from pathlib import Path

import numpy as np
import pytest
from run_files import drawn_lines, make_object_rollouts, make_rollouts, run_of, titles
from safetensors.numpy import save_file

from torchrl_koap.evaluation.statistics import expected_entropy
from torchrl_koap.reports import scenes
from torchrl_koap.reports.animation import animate_rollouts
from torchrl_koap.reports.pictures import NothingToDraw, all_pictures
from torchrl_koap.reports.rollout_plots import (
    choose_episodes,
    draw_modes,
    draw_plans,
    draw_rollouts,
    mode_colors,
    plan_deviation,
    recorded_modes,
)
from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.reports.style import INK
from torchrl_koap.tasks import TASKS, Action, Modes, Task, get_task


def drawn(task, mode, folder=Path("run")):
    mode = np.array(mode)
    return draw_modes({"mode": mode, "outcome": np.ones(len(mode))}, run_of(task, folder))


def test_modes_histogram(tmp_path):
    gaps = [(0.4, 0.5, 0.42), (0.4, 0.5, 0.42), (0.4, 0.5, 0.58)]  # of modes 5, 5 and 6
    paths = [np.stack([x, (-0.1, 0.08, 0.27)], 1) for x in gaps] + [np.array([[0.5, -0.3]])]
    recorded = {"position": np.concatenate(paths), "episode": np.repeat(range(4), [3, 3, 3, 1])}
    save_file(recorded, tmp_path / "demonstrations.safetensors")
    figure = drawn("avoiding", [0, 0, 23, 23, -1], tmp_path)
    axes = figure.axes[0]
    assert [bar.get_height() for bar in axes.patches] == [2] + [0] * 22 + [2]
    assert titles(figure)[0].startswith(f"2 of 24 modes, entropy {math.log(2, 24):.2f};")
    even = f"{expected_entropy(4, 24):.2f} on average at n = 4"
    assert titles(figure)[0].endswith(f"; a uniform choice gives {even}; 1 without a mode")
    assert [axes.texts[group].get_text() for group in (0, 1, 5)] == ["left / left", "left / middle", "right / right"]
    levels = [line[0][1] for line in drawn_lines(axes)]
    assert levels[5] == pytest.approx(4 * 2 / 3) and sum(levels) == pytest.approx(4)
    np.testing.assert_allclose(
        [bar.get_facecolor()[:3] for bar in axes.patches], mode_colors(get_task("avoiding").modes)
    )


def test_modes_in_words():
    bars = drawn("sorting_2", [0, 1, 1]).axes[0]
    assert [tick.get_text() for tick in bars.get_xticklabels()] == ["red\nblue", "blue\nred"]
    assert [bar.get_height() for bar in bars.patches] == [1, 2]
    assert len(drawn("sorting_6", range(20)).axes[0].patches) == 20


def test_without_a_choice_there_is_nothing_to_draw():
    with pytest.raises(NothingToDraw, match="only one mode"):
        drawn("scooping", [0, 0])


def test_modes_of_recorded_paths_are_those_of_the_rule(tmp_path):
    """The black ticks: rows are passed left or right of the cylinders, whatever the frames between."""
    left = [[0.45, -0.2], [0.44, -0.11], [0.4, 0.0], [0.4, 0.07], [0.3, 0.2], [0.3, 0.27], [0.3, 0.36]]
    right = [[0.55, -0.09], [0.6, 0.1], [0.7, 0.3]]
    short = [[0.5, -0.3], [0.5, -0.2]]
    file = tmp_path / "demonstrations.safetensors"
    save_file({"position": np.array(left + right + short), "episode": np.repeat([0, 1, 2], [7, 3, 2])}, file)
    assert recorded_modes(file, get_task("avoiding").modes).tolist() == [0, 23]  # the last one passes no row
    assert recorded_modes(file, get_task("aligning").modes).tolist() == []
    assert recorded_modes(tmp_path / "none", get_task("avoiding").modes).tolist() == []


@pytest.mark.parametrize("task", [name for name, task in TASKS.items() if task.modes.choices])
def test_every_mode_has_its_color(task):
    colors, number = mode_colors(TASKS[task].modes), TASKS[task].modes.number
    apart = np.abs(colors[:, None] - colors[None]).sum(-1) + 10 * np.eye(number)
    assert colors.shape == (number, 3) and apart.min() > 0.08
    assert len(mode_colors(Modes())) == 1


def test_modes_that_are_called_by_colors_have_them():
    red, green, blue = mode_colors(get_task("stacking_1").modes)
    assert red.argmax() == 0 and green.argmax() == 1 and blue.argmax() == 2


ROLLOUTS = make_rollouts()


def test_rollouts_are_cut_coloured_and_counted():
    figure = draw_rollouts(ROLLOUTS, run_of("avoiding"))
    (axes,) = figure.axes
    assert titles(figure)[0] == "2 of 4 rollouts succeed, out of time: 1, collision: 1"
    lines = axes.collections[0]
    np.testing.assert_allclose(lines.get_segments(), ROLLOUTS["position"][:2])
    np.testing.assert_allclose(lines.get_colors()[:, :3], mode_colors(get_task("avoiding").modes)[:2])
    late, hit = axes.lines[1:]  # the first line is the finish
    assert len(late.get_xdata()) == 20 and len(hit.get_xdata()) == 10 and late.get_color() == hit.get_color() == INK
    np.testing.assert_allclose(axes.collections[-1].get_offsets()[0], ROLLOUTS["position"][3, 9])
    assert [len(mark.get_paths()[0]) for mark in axes.collections[-2:]] == [5, 13]  # corners of a square, of a cross


@pytest.mark.parametrize("task", ["aligning", "sorting", "stacking", None])
def test_objects_get_a_panel(task):
    rollouts = make_object_rollouts(task or "stacking")
    bodies = scenes.bodies_of(run_of(task).task, rollouts["context"].shape[1])
    figure = draw_rollouts(rollouts, run_of(task))
    beside = figure.axes[1]
    assert beside.get_title(loc="left").startswith("objects")
    for index, body in enumerate(bodies):
        wanted = [rollouts["object_position"][e, : 21 if e < 3 else 11, index] for e in range(4)]
        found = [line for line in drawn_lines(beside) if len(line) in (20, 11) and np.allclose(line[0], wanted[0][0])]
        assert bool(found) is not body.still
        if found:
            np.testing.assert_allclose(found[0], wanted[0])
    entries = [text.get_text() for text in beside.get_legend().get_texts()]
    assert entries[:2] == ["out of time", "collision"] and entries[-2:] == ["end", "end of a failure"]
    assert entries[2:-2] == list(dict.fromkeys(body.label for body in bodies))


def test_plans_lie_over_their_path():
    aside, along = np.full((14, 1), 0.001), ROLLOUTS["position"][1, -1] - ROLLOUTS["position"][1, 0]
    normal = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    plan = ROLLOUTS["plan"].copy()
    plan[1] += aside * normal
    plan[1, 0, 0] += 0.01 * normal  # one of 16 points
    figure = draw_plans(ROLLOUTS | {"plan": plan}, run_of("avoiding"))
    assert {(axes.get_xlabel(), axes.get_ylabel()) for axes in figure.axes} == {("x (m)", "y (m)")}
    axes = figure.axes[3]
    assert axes.get_title(loc="left") == "episode 1: left, left, gap 2\noff the path: median 1.0, 95 % within 3.5 mm"
    assert titles(figure)[:2] == [
        f"episode {n}: {end}\noff the path: median 0.0, 95 % within 0.0 mm"
        for n, end in ((2, "out of time"), (3, "collision"))
    ]
    lines = drawn_lines(axes)
    assert len(lines) == 4 and all(len(line) == 4 for line in lines)
    np.testing.assert_allclose(axes.collections[1].get_offsets(), ROLLOUTS["position"][1, [0, 4, 8, 12]])


def test_plans_stand_beside_the_starts_of_their_own_episode():
    rollouts = make_object_rollouts("sorting")
    for axes, episode in zip(draw_plans(rollouts, run_of("sorting")).axes, (2, 3, 0, 1), strict=True):
        centres = [line[:4].mean(0) for line in drawn_lines(axes) if len(line) == 5]  # of outlines
        np.testing.assert_allclose(centres, rollouts["context"][episode, :, :2])


def test_plan_deviation_is_the_distance_to_the_polyline():
    generator = np.random.default_rng(0)
    path, plan = generator.normal(size=(7, 2)), generator.normal(size=(30, 2))
    share = np.linspace(0, 1, 4001)[:, None]
    fine = np.concatenate([a + share * (b - a) for a, b in zip(path[:-1], path[1:], strict=True)])
    brute = np.linalg.norm(plan[:, None] - fine, axis=-1)
    reached = brute.argmin(1) < len(fine) - 1
    np.testing.assert_allclose(plan_deviation(path, [plan[:10], plan[10:]]), brute.min(1)[reached], atol=1e-3)
    assert plan_deviation(path[:1], [plan]).size == 0


@pytest.mark.parametrize(
    ("mode", "outcome", "count", "wanted"),
    [
        ([3, 3, 5, 5], [1, 1, 1, 1], 3, [0, 2, 1]),
        (range(24), [1] * 24, 4, [0, 8, 15, 23]),
        ([-1] * 5, [2] * 5, 4, [0, 1, 2, 3]),
        ([-1, 4], [0, 1], 6, [0, 1]),
        ([], [], 6, []),
    ],
)
def test_episodes_are_chosen_for_variety(mode, outcome, count, wanted):
    assert choose_episodes(np.array(mode), np.array(outcome), count) == wanted


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mode": None}, "missing entry 'mode'"),
        ({"position": np.zeros((4, 20, 3))}, r"'position' must have shape \[any, any, 2\], got \[4, 20, 3\]"),
        ({"outcome": np.zeros(3)}, r"'outcome' must have shape \[4\], got \[3\]"),
        ({"plan_step": np.zeros((4, 2))}, r"'plan_step' must have shape \[4, 5\]"),
    ],
)
def test_bad_rollouts(change, message):
    rollouts = {key: value for key, value in (ROLLOUTS | change).items() if value is not None}
    with pytest.raises(ValueError, match=message):
        draw_plans(rollouts, run_of("avoiding"))


def test_plans_are_drawn_over_time_without_planar_positions():
    parts, acting, units = {"hand": ("thumb", "finger", "palm")}, {"a": Action(), "b": Action()}, ("", "rad", "")
    task = Task(name="hand", observation_parts=parts, actions=acting, position="hand", observation_units=units)
    run = RunFacts(Path("run"), task)
    state = np.random.default_rng(0).normal(size=(4, 21, 2)).cumsum(1)
    plan = np.full((4, 5, 14, 2), np.nan)
    plan[:, 0] = state[:, 1:15]
    hand = ROLLOUTS | {"column": np.array([2, 1]), "state": state, "state_plan": plan}
    figure = draw_plans(hand, run)
    assert len(figure.axes) == 6 and [axes.get_ylabel() for axes in figure.axes[::3]] == ["palm", "finger (rad)"]
    heads = [axes.get_title(loc="left") for axes in figure.axes[:3]]
    assert heads == ["episode 2: out of time", "episode 3: collision", "episode 0: success"]
    np.testing.assert_allclose(figure.axes[5].lines[0].get_ydata(), state[0, :, 1])
    figure.axes[5].set_xlim(0, 3)
    assert set(figure.axes[5].get_xticks()) <= set(range(-1, 5))  # whole control steps
    planned = figure.axes[5].collections[0].get_segments()[0]
    np.testing.assert_allclose(planned, np.stack([np.arange(1, 15), state[0, 1:15, 1]], 1))
    assert "columns that actions move" in all_pictures()["plans.png"].caption_for(run)
    for draw in (draw_rollouts, animate_rollouts):
        with pytest.raises(NothingToDraw, match="it is not known which columns are planar"):
            draw(hand, run)
