# This source code is licensed under the MIT license found in the LICENSE file.
"""Every section refuses numbers out of range by its own name."""

import pytest

from torchrl_koap import ControllerConfig, LabelConfig, PlannerConfig, RunConfig, TrainConfig


@pytest.mark.parametrize(
    ("section", "options", "message"),
    [
        (LabelConfig, {"fraction": 0.0}, r"labels: fraction must be in \(0, 1\], got 0.0"),
        (LabelConfig, {"trajectories": 0}, "labels.trajectories must be > 0 and <= 1, got 0"),
        (PlannerConfig, {"width": 0}, "planner.width must be >= 1, got 0"),
        (PlannerConfig, {"learning_rate": 0.0}, "planner.learning_rate must be > 0, got 0.0"),
        (PlannerConfig, {"frames": 3}, "planner.frames must be >= 1 and <= 2, got 3"),
        (PlannerConfig, {"held_out": 1.0}, "planner.held_out must be >= 0 and < 1, got 1.0"),
        (PlannerConfig, {"source": "pretrained:avoidin"}, "did you mean 'avoiding'"),
        (ControllerConfig, {"steps": -1}, "controller.steps must be >= 0, got -1"),
        (RunConfig, {"seed": -1}, "run.seed must be >= 0, got -1"),
        (RunConfig, {"device": "gpu"}, "device must be 'cpu' or 'cuda', got 'gpu'"),
        (RunConfig, {"precision": "float8"}, "unknown precision 'float8'"),
    ],
)
def test_what_is_refused(section, options, message):
    with pytest.raises(ValueError, match=message):
        section(**options)


def test_a_string_will_do_for_a_path():
    assert TrainConfig(out="runs/a").out.name == "a"
    assert PlannerConfig(source="runs/b").source.name == "b"
