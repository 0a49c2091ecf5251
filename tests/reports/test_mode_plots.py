# This source code is licensed under the MIT license found in the LICENSE file.
"""Modes as bars, ticks and colours."""

import math
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import rgb_to_hsv
from run_files import drawn_lines, run_of, titles
from safetensors.numpy import save_file

from torchrl_koap.reports.mode_plots import draw_modes, mode_colors, recorded_modes
from torchrl_koap.reports.pictures import NothingToDraw
from torchrl_koap.tasks import TASKS, Modes, get_task


def drawn(task, mode, folder=Path("run")):
    mode = np.array(mode)
    return draw_modes({"mode": mode, "outcome": np.ones(len(mode))}, run_of(task, folder))


def test_modes_histogram(tmp_path):
    save_file({"mode": np.array([5, 5, 6, -1])}, tmp_path / "demonstrations.safetensors")
    figure = drawn("avoiding", [0, 0, 23, 23, -1], tmp_path)
    axes = figure.axes[0]
    assert [bar.get_height() for bar in axes.patches] == [2] + [0] * 22 + [2]
    assert titles(figure)[0].startswith(f"2 of 24 modes, entropy {math.log(2, 24):.2f};")
    assert titles(figure)[0].endswith("; 1 without a mode")
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
    with pytest.raises(NothingToDraw, match="no choice"):
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


def test_colors_are_distinct_with_hue_by_last_row_and_lightness_by_the_others():
    colors = mode_colors(get_task("avoiding").modes)
    apart = np.abs(colors[:, None] - colors[None]).sum(-1) + 10 * np.eye(24)
    assert apart.min() > 0.08 and colors.min() >= 0 and colors.max() <= 1
    hue = rgb_to_hsv(colors)[:, 0].reshape(6, 4)
    spread = np.abs(np.angle(np.exp(2j * np.pi * (hue - hue[2:3])))) / (2 * np.pi)
    assert spread.max() < 0.06  # a column keeps its hue
    between = np.abs(np.angle(np.exp(2j * np.pi * (hue[:, :, None] - hue[:, None])))) / (2 * np.pi)
    assert between[:, ~np.eye(4, dtype=bool)].min() > 0.08
    luminance = (colors @ [0.2126, 0.7152, 0.0722]).reshape(6, 4)
    assert (np.diff(luminance, axis=0) > 0).all()


@pytest.mark.parametrize("task", [name for name, task in TASKS.items() if task.modes.choices])
def test_every_mode_has_its_color(task):
    colors, number = mode_colors(TASKS[task].modes), TASKS[task].num_modes
    apart = np.abs(colors[:, None] - colors[None]).sum(-1) + 10 * np.eye(number)
    assert colors.shape == (number, 3) and apart.min() > 0.08
    assert len(mode_colors(Modes())) == 1
