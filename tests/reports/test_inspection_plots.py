# This source code is licensed under the MIT license found in the LICENSE file.
"""Spectrum, latent space and experiments: figures say what the numbers say."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from run_files import run_of, titles
from safetensors.numpy import save_file

from torchrl_koap.evaluation.findings import MODELS, OUTSIDE_THE_BUDGET
from torchrl_koap.evaluation.latent_space import spectrum
from torchrl_koap.reports.inspection_plots import EXPERIMENTS, draw_eigenvalues, draw_experiments, draw_latent
from torchrl_koap.reports.pictures import NothingToDraw

RUN = run_of("avoiding")


def test_eigenvalues_outside_the_circle_are_counted():
    figure = draw_eigenvalues({"real": np.array([0.5, 0.6, 0.0]), "imag": np.array([0.0, 0.9, 1.0])}, RUN)
    assert titles(figure)[0] == "3 eigenvalues, radius 1.0817\n1 inside, 1 on, 1 outside the unit circle"
    inside, on, outside = (item.get_offsets() for item in figure.axes[1].collections)
    np.testing.assert_allclose(inside, [[3, -0.5]])
    np.testing.assert_allclose(on, [[2, 0.0]], atol=1e-7)
    np.testing.assert_allclose(outside, [[1, math.hypot(0.6, 0.9) - 1]], rtol=1e-6)


def test_eigenvalues_near_the_circle_are_counted_as_in_the_text():
    """Eigenvalues within 2 % of 1, some nearer than the tolerance: figure, legend and `koap inspect` agree."""
    size = np.array([1.006, 1.0009, 1.00001, 0.9995, 0.995, 0.981])
    figure = draw_eigenvalues({"real": size, "imag": np.zeros(6)}, RUN)
    facts = spectrum(torch.from_numpy(size).to(torch.complex128))
    counted = {name: facts[name] for name in ("inside", "on", "outside")}
    assert counted == {"inside": 2, "on": 3, "outside": 1}
    assert titles(figure)[0].endswith("2 inside, 3 on, 1 outside the unit circle")
    rank = figure.axes[1]
    legend = [text.get_text() for text in rank.get_legend().get_texts()]
    assert legend == [f"{name} the circle: {number}" for name, number in counted.items()]
    figure.draw_without_rendering()
    places = rank.transData.transform([(0, value - 1) for value in size])[:, 1]
    height = rank.get_window_extent().height
    assert places[0] - places[1] > 0.1 * height and places[3] - places[4] > 0.1 * height  # told apart by eye


@pytest.mark.parametrize("real", [[math.nan, 1.0], []])
def test_bad_eigenvalues(real):
    with pytest.raises(ValueError, match="finite and at least one"):
        draw_eigenvalues({"real": np.array(real), "imag": np.zeros(len(real))}, RUN)


@pytest.mark.parametrize(
    ("outside", "panels", "said"),
    [
        ({"labels_read": 50, "held_out_trajectories": 4}, 2, "reads 50 labels, outside the budget"),
        ({"labels_read": 50, "held_out_trajectories": 4, "held_out_in_budget": 4}, 2, "the decoder has seen"),
        ({"note": "no label lies outside the budget"}, 1, ""),
    ],
)
def test_latent_space(outside, panels, said, tmp_path):
    errors = {name: {"measured_xy": [0.001, 0.002]} for name in MODELS} | {"steps": 2, "held_out_trajectories": 3}
    outside = outside if "note" in outside else {"probe_r2": [0.9, 0.8], "decoder_r2": [0.7, 0.6]} | outside
    result = {"latent": {"multi_step": errors, OUTSIDE_THE_BUDGET: outside, "eigenvalues": {}}}
    figure = draw_latent(result, run_of("avoiding", tmp_path))
    assert len(figure.axes) == panels and figure.get_suptitle().endswith(said)
    assert titles(figure)[0] == "Error of the predicted measured xy\non 3 demonstrations"
    save_file({"real": np.ones(3), "imag": np.zeros(3)}, tmp_path / "eigenvalues.safetensors")
    figure = draw_latent(result, run_of("avoiding", tmp_path))
    assert titles(figure)[0].startswith("3 eigenvalues") and len(figure.axes) == panels + 1


def test_experiments():
    result = {name: {"rate": 0.5, "low": 0.2, "high": 0.8, "episodes": 9} for name in EXPERIMENTS}
    result |= {"plan_to_execution": {"measured_xy": [0.001, 0.002]}, "recording_to_execution": {}}
    left, right = draw_experiments(result, RUN).axes
    assert [bar.get_height() for bar in left.patches] == [50.0] * 3
    assert right.patches[0].get_width() == 0.002
    with pytest.raises(NothingToDraw, match="left out"):
        draw_experiments({"latent": {}}, RUN)
    with pytest.raises(NothingToDraw, match="no latent space"):
        draw_latent({"latent": {"note": "a ridge"}}, RUN)
