# This source code is licensed under the MIT license found in the LICENSE file.
"""The picture of the demonstrations: which steps it shows as labelled, and the objects beside it."""

from __future__ import annotations

import numpy as np
import torch
from figure_parts import drawn_lines, titles
from run_files import make_demonstrations

from torchrl_koap.reports import demonstration_plot


def test_demonstrations_emphasise_exactly_the_labelled_transitions(figures, tmp_path):
    data = make_demonstrations()
    data["labelled"] = torch.zeros(40, dtype=torch.bool)
    data["labelled"][[3, 19, 25]] = True  # 19 is the last step of the first one: no line to the second
    demonstration_plot.plot_demonstrations(data, tmp_path / "a.png")
    axes = figures[0].axes[0]
    grey, blue = axes.collections
    assert [len(line) for line in grey.get_segments()] == [20, 20]
    np.testing.assert_allclose(blue.get_segments(), torch.stack([data["state"][[3, 25]], data["state"][[4, 26]]], 1))
    assert titles(figures[0])[0] == ("2 demonstrations; labels on 3 of 40 transitions (7.5%)\nin 2 of 2 demonstrations")


def test_demonstrations_with_objects(figures, tmp_path):
    data = make_demonstrations() | {"state": torch.rand(40, 8), "position": make_demonstrations()["state"]}
    data["objects"] = torch.rand(40, 3, 2)
    demonstration_plot.plot_demonstrations(data, tmp_path / "a.png", task="stacking")
    axes, beside = figures[0].axes
    np.testing.assert_allclose(axes.collections[0].get_segments()[1], data["position"][20:])
    np.testing.assert_allclose(drawn_lines(beside)[3], data["objects"][20:, 1])  # green box of the second one
    assert [text.get_text() for text in beside.get_legend().get_texts()] == ["red box", "green box", "blue box", "end"]


def test_first_columns_of_older_demonstrations_are_the_position(figures, tmp_path):
    data = make_demonstrations()
    data["state"] = torch.cat([data["state"], torch.rand(40, 5)], 1)
    demonstration_plot.plot_demonstrations(data, tmp_path / "a.png", task="aligning")
    np.testing.assert_allclose(figures[0].axes[0].collections[0].get_segments()[0], data["state"][:20, :2])
