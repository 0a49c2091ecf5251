# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the picture of demonstrations: labelled steps and objects."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from run_files import drawn_lines, make_demonstrations, run_of, titles

from torchrl_koap.reports.demonstrations import draw_demonstrations
from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.tasks import Action, Task


def test_demonstrations_emphasise_exactly_the_labelled_transitions():
    data = make_demonstrations() | {"labelled": np.isin(np.arange(40), [3, 19, 25])}
    figure = draw_demonstrations(data, run_of("avoiding"))  # 19 is the last step of the first one: no line
    grey, blue = figure.axes[0].collections
    assert [len(line) for line in grey.get_segments()] == [20, 20]
    np.testing.assert_allclose(blue.get_segments(), np.stack([data["position"][[3, 25]], data["position"][[4, 26]]], 1))
    assert titles(figure) == ["2 demonstrations; labels on 3 of 40 transitions (7.5%)\nin 2 of 2 demonstrations"]


def test_demonstrations_with_objects():
    data = make_demonstrations() | {"objects": np.random.rand(40, 3, 2)}
    axes, beside = draw_demonstrations(data, run_of("stacking")).axes
    np.testing.assert_allclose(axes.collections[0].get_segments()[1], data["position"][20:])
    assert (axes.get_xlim(), axes.get_ylim()) == (beside.get_xlim(), beside.get_ylim())  # only one has tick labels
    np.testing.assert_allclose(drawn_lines(beside)[3], data["objects"][20:, 1])  # green box of the second one
    assert [text.get_text() for text in beside.get_legend().get_texts()] == ["red box", "green box", "blue box", "end"]


def test_columns_over_time_where_there_is_no_environment():
    names = tuple(f"q{index}" for index in range(14))
    parts, acting = {"joints": names}, {"a": Action("rad")}
    arm = Task(name="arm", observation_parts=parts, actions=acting, position="joints", control_hz=10.0)
    arm = replace(arm, observation_units=("rad",) * 14)
    data = make_demonstrations() | {"state": np.random.rand(40, 14)}
    figure = draw_demonstrations(data, RunFacts(Path("run"), arm))
    assert titles(figure) == [f"{name} (rad)" for name in names[:12]]
    second = drawn_lines(figure.axes[2])[1]
    np.testing.assert_allclose(second, np.stack([np.arange(20) / 10, data["state"][20:, 2]], 1))
    assert figure.get_suptitle().endswith("in 1 of them; 2 columns are not drawn")


def test_missing_positions():
    data = {key: value for key, value in make_demonstrations().items() if key != "position"}
    with pytest.raises(ValueError, match="missing entry 'position'; got episode, labelled, mode"):
        draw_demonstrations(data, run_of("avoiding"))
