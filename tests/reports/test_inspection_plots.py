# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests plots of spectrum, latent space and experiments against their numbers."""

import math
from pathlib import Path

import numpy as np
import pytest
from run_files import run_of, titles

from torchrl_koap.evaluation.findings import EXPERIMENTS, MODELS, OUTSIDE_THE_BUDGET
from torchrl_koap.reports.inspection_plots import draw_experiments, draw_latent
from torchrl_koap.reports.pictures import NothingToDraw
from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.tasks import Action, Task

RUN = run_of("avoiding")


@pytest.mark.parametrize(
    ("outside", "panels", "said"),
    [
        (
            {"labels_read": 50, "held_out_trajectories": 4, "held_out_in_budget": 2},
            3,
            "reads 50 labels, also outside the budget",
        ),
        ({"labels_read": 50, "held_out_trajectories": 4, "held_out_in_budget": 4}, 3, "the decoder has seen"),
        ({"note": "no label lies outside the budget"}, 2, ""),
    ],
)
def test_latent_space(outside, panels, said):
    errors = {name: {"measured_xy": [0.001, 0.002]} for name in MODELS} | {"steps": 2, "held_out_trajectories": 3}
    outside = outside if "note" in outside else {"probe_r2": [0.9, 0.8], "decoder_r2": [0.7, 0.6]} | outside
    size = [1.006, 1.0009, 1.00001, 0.9995, 0.995, 0.981]  # some nearer to 1 than the tolerance
    turn = np.array([0, 0, 0.1, 0, 0, 0])  # rad
    facts = {"real": (size * np.cos(turn)).tolist(), "imag": (size * np.sin(turn)).tolist()}
    result = {"latent": {"multi_step": errors, OUTSIDE_THE_BUDGET: outside, "eigenvalues": facts}}
    figure = draw_latent(result, RUN)
    assert len(figure.axes) == panels and figure.get_suptitle().endswith(said)
    assert titles(figure)[0] == "6 eigenvalues, radius 1.006\n2 inside, 3 on, 1 outside the unit circle"
    assert titles(figure)[1] == "Error of the predicted measured xy\non 3 demonstrations"
    for line in figure.axes[1].lines:
        np.testing.assert_allclose(line.get_xydata(), [[1, 1], [2, 2]])  # steps, mm
    if panels == 3:
        assert [bar.get_height() for bar in figure.axes[2].patches] == [0.9, 0.8, 0.7, 0.6]
    facts |= {"real": [9.0], "imag": [0.0]}
    assert draw_latent(result, RUN).axes[0].get_xlim() == pytest.approx((-4.4, 4.4))


def test_numbers_of_many_actions_stay_below_the_title_and_one_without_a_value_keeps_its_place():
    names = tuple(f"finger_{index}" for index in range(6))
    task = Task(
        name="hand", observation_parts={"hand": names}, actions={name: Action() for name in names}, position="hand"
    )
    explained = [1.0] * 5 + [math.nan]
    latent = {
        "multi_step": {name: {"hand": [0.1]} for name in MODELS} | {"steps": 1, "held_out_trajectories": 3},
        OUTSIDE_THE_BUDGET: {
            "probe_r2": explained,
            "decoder_r2": explained,
            "labels_read": 9,
            "held_out_trajectories": 3,
        },
        "eigenvalues": {"real": [0.9], "imag": [0.0]},
    }
    figure = draw_latent({"latent": latent}, RunFacts(Path("run"), task))
    figure.draw_without_rendering()
    axes = figure.axes[2]
    assert len(axes.texts) == 10 and max(text.get_window_extent().y1 for text in axes.texts) < axes.bbox.y1
    assert axes.get_xlim()[1] == pytest.approx(5.6)


def test_experiments():
    result = {name: {"rate": 0.5, "low": 0.2, "high": 0.8, "episodes": 9} for name in EXPERIMENTS}
    result |= {"plan_to_execution": {"measured_xy (m)": [0.001, 0.002]}, "recording_to_execution": {}}
    left, right = draw_experiments(result, RUN).axes
    assert [bar.get_height() for bar in left.patches] == [50.0] * 3
    assert right.patches[0].get_width() == 0.002
    assert [text.get_text() for text in right.get_legend().get_texts()] == ["from the plan"]  # what was not measured
    with pytest.raises(NothingToDraw, match="left out"):
        draw_experiments({"latent": {}}, RUN)
    with pytest.raises(NothingToDraw, match="no latent space"):
        draw_latent({"latent": {"note": "a ridge"}}, RUN)
