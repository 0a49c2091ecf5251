# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests options as JSON: written files are read back, and errors name file and option."""

import json

import pytest

from torchrl_koap import ControllerConfig, ExecutionConfig, LabelConfig, PlannerConfig, RunConfig, TrainConfig
from torchrl_koap.runs.config_files import changed_options, code_checksum, from_json, to_json, version_of
from torchrl_koap.runs.run_directory import RunDirectoryError


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"labels": LabelConfig(episodes=(1, 4)), "run": RunConfig(plugins=("math",), seed=3)},
        {"planner": PlannerConfig(network="mlp", width=64, source="runs/a"), "execution": ExecutionConfig(blend=0.5)},
        {"method": "dp", "labels": LabelConfig(count=3), "controller": ControllerConfig(columns="all")},
        {"execution": ExecutionConfig(limits=float("inf"))},
    ],
)
def test_what_is_written_may_be_read(options):
    config = TrainConfig(out="run", task="avoiding", **options)
    assert from_json(TrainConfig, json.loads(json.dumps(to_json(config), allow_nan=False)), "config.json") == config


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"planner": None}, "a.json: planner must be an object, got None"),
        ([], r"a.json: the file must be an object, got \[\]"),
        ({"run": {"seed": True}}, "a.json: run.seed must be int, got True"),
        ({"run": {"seed": 10**30}}, "a.json: run.seed must be int"),
        ({"labels": {"episodes": [8, "a"]}}, r"a.json: labels.episodes must be a list of int, got \[8, 'a'\]"),
        ({"planner": {"learning_rate": "x" * 99}}, "planner.learning_rate must be a number or null, got 'x+..."),
        ({"out": 3}, "a.json: out must be a path, got 3"),
        ({"execution": {"blend": "inf"}}, r"a.json: blend must be in \[0, 1\), got inf"),
        ({"planner": {"network": "inf", "steps": "inf"}}, "a.json: planner.steps must be int or null, got 'inf'"),
        ({"labels": {"fraction": 0.0}}, r"a.json: labels: fraction must be in \(0, 1\], got 0.0"),
        ({"labels": {"trajectories": 0}}, "labels.trajectories must be > 0 and <= 1, got 0"),
        ({"planner": {"width": 0}}, "a.json: planner.width must be >= 1, got 0"),
        ({"planner": {"learning_rate": 0.0}}, "planner.learning_rate must be > 0, got 0.0"),
        ({"planner": {"frames": 3}}, "planner.frames must be >= 1 and <= 2, got 3"),
        ({"planner": {"held_out": 1.0}}, "planner.held_out must be >= 0 and < 1, got 1.0"),
        ({"planner": {"source": "pretrained:avoidin"}}, "did you mean 'avoiding'"),
        ({"controller": {"steps": -1}}, "controller.steps must be >= 0, got -1"),
        ({"run": {"seed": -1}}, "run.seed must be >= 0, got -1"),
        ({"run": {"device": "gpu"}}, "device must be 'cpu' or 'cuda', got 'gpu'"),
        ({"run": {"precision": "float8"}}, "unknown precision 'float8'"),
        ({"labels": {"cuont": 5}}, "a.json: unknown option of labels 'cuont'; did you mean 'count'?"),
        ({"steps": 5}, "a.json: unknown option 'steps'; known: dataset, out, "),
    ],
)
def test_the_option_is_named(content, message):
    with pytest.raises(RunDirectoryError, match=message):
        from_json(TrainConfig, content if isinstance(content, list) else {"out": "run"} | content, "a.json")


def test_changes_are_named_with_their_section():
    one = TrainConfig(out="run", planner=PlannerConfig(steps=3))
    other = TrainConfig(out="run", planner=PlannerConfig(steps=4), method="dd")
    assert changed_options(one, other) == ["method", "planner.steps"] and not changed_options(one, one)


def test_a_package_without_metadata_has_no_version():
    assert version_of("no_such_package") == "MISSING"


def test_the_checksum_of_the_code_is_that_of_names_and_contents(tmp_path):
    for number, (name, text) in enumerate((("a.py", "x = 1"), ("a.py", "x = 1"), ("a.py", "x = 2"), ("b.py", "x = 1"))):
        (tmp_path / str(number)).mkdir()
        (tmp_path / str(number) / name).write_text(text)
    one, same, changed, renamed = (code_checksum(tmp_path / str(number)) for number in range(4))
    assert one == same and len({one, changed, renamed, code_checksum()}) == 4
