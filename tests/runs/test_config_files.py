# This source code is licensed under the MIT license found in the LICENSE file.
"""Options read from a file: every field of a configuration has a type that is checked, and its own values pass."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest

from torchrl_koap.runs.config import TrainConfig
from torchrl_koap.runs.config_files import CONTROLLER, PLANNER, check_config, check_types
from torchrl_koap.runs.run_directory import RunDirectoryError
from torchrl_koap.studies import CurveConfig
from torchrl_koap.training.provenance import to_json
from torchrl_koap.training.resolved import resolve


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"label_episodes": (1, 4), "channels": (8, 16), "plugins": ("math",)},
        {"denoiser": "mlp", "denoiser_width": 64},
        {"method": "dp", "label_count": 3},
    ],
)
def test_what_is_written_may_be_read(options):
    content = json.loads(json.dumps(to_json(resolve(TrainConfig(out="run", task="avoiding", **options)))))
    check_config("config.json", content)
    assert set(content["planner"]) <= set(PLANNER) and set(content["controller"]) <= set(CONTROLLER)


def test_every_field_is_checked():
    for field in dataclasses.fields(TrainConfig):
        with pytest.raises(RunDirectoryError, match=f"config.json is damaged: entry '{field.name}' must be .*, got"):
            check_config("config.json", {field.name: {"of": "nothing"}})


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"planner": None}, "entry 'planner' must be an object, got None"),
        ({"seed": True}, "entry 'seed' must be int, got True"),
        ({"seed": 10**30}, "entry 'seed' must be int"),
        ({"planner": {"channels": [8, "a"]}}, r"entry 'planner.channels' must be a list of int, got \[8, 'a'\]"),
        ({"planner_learning_rate": "x" * 99}, "entry 'planner_learning_rate' must be a number or null, got 'x+..."),
        ({"controller": {"decoder": 3}}, "entry 'controller.decoder' must be text or null, got 3"),
        ({"out": 3}, "entry 'out' must be a path, got 3"),
    ],
)
def test_the_entry_is_named(content, message):
    with pytest.raises(RunDirectoryError, match=message):
        check_config("config.json", content)


def test_unknown_and_missing_entries_are_nobodys_fault():
    check_config("config.json", {"of_another_version": [1, {}], "planner": {}})


def test_other_dataclasses():
    check_types(Path("curve.json"), {"seeds": 3}, {"seeds": int})
    assert "seeds" in {field.name for field in dataclasses.fields(CurveConfig)}
    with pytest.raises(RunDirectoryError, match="curve.json is damaged: entry 'seeds' must be int, got 'x'"):
        check_types(Path("curve.json"), {"seeds": "x"}, {"seeds": int})
