# This source code is licensed under the MIT license found in the LICENSE file.
"""Options of `koap eval`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from torchrl_koap.modules import ExecutionConfig
from torchrl_koap.runs.device import check_machine
from torchrl_koap.runs.plugins import Plugins


@dataclass
class EvalConfig:
    """Rollouts of a trained run in closed loop; without an environment, its errors on recorded data.

    Attributes:
        episodes: number of rollouts.
        seed: seed of the first rollout; rollout i has this seed plus i.
        execution: how plans become actions; options not given are the run's.
        out: folder to write to instead of the run's own; the files of the run are copied there.
        env: id of a Gymnasium environment to roll out in instead of the task's own, such as "my_package:Reach-v0".
        env_kwargs: arguments of gymnasium.make, such as obs_type=state max_episode_steps=300.
        success_key: entry of its info that says whether the task is done (default: "is_success" or "success"; without
            them, an episode that terminates with more than twice any earlier reward succeeds).
        num_envs: environments at a time, each in a process of its own (default: all in this process).
        dataset: where the data set of the training is now (default: where it was).
        threads: torch and simulator threads (default: OMP_NUM_THREADS where it is set, else 1).
        device: "cpu" or "cuda".
        plugins: modules that register tasks, methods or pictures, besides those that the run was trained with.
        rollouts_per_context: rollouts in each context (place of the objects); from 2 on the report has the entropy of
            the modes per context.
        batch_size: episodes at a time; contexts and noise do not depend on it, the last digits of actions do.
        contexts_file: a context file of D3IL, instead of the 60 contexts of the library.

    Raises:
        ValueError: for a number out of range, or options that do not go together.
    """

    episodes: int = 60
    seed: int = 100
    execution: Annotated[ExecutionConfig, tyro.conf.arg(name="")] = ExecutionConfig()
    out: Path | None = None
    env: str | None = None
    env_kwargs: tuple[str, ...] = ()
    success_key: str | None = None
    num_envs: int | None = None
    dataset: str | None = None
    threads: int | None = None
    device: str = "cpu"
    plugins: Plugins = ()
    rollouts_per_context: int = 1
    batch_size: int | None = None
    contexts_file: Path | None = None

    def __post_init__(self):
        for name in ("episodes", "num_envs", "batch_size", "rollouts_per_context"):
            value = vars(self)[name]
            if value is not None and value < 1:
                raise ValueError(f"{name} must be >= 1, got {value}")
        check_machine(self.threads, self.device)
        if self.seed < 0:
            raise ValueError(f"seed must be >= 0, got {self.seed}")
        environment_arguments(self.env_kwargs)
        given = [name for name in ("success_key", "env_kwargs", "num_envs") if vars(self)[name]]
        if given and self.env is None:
            raise ValueError(f"{given[0]} was given, but no env: name an environment of Gymnasium with --env")
        if self.num_envs is not None and self.batch_size is not None:
            raise ValueError("num_envs and batch_size both say how many episodes run at a time: give one of them")


def environment_arguments(words: Sequence[str]) -> dict[str, Any]:
    """Reads ``key=value`` words: numbers, lists, true, false and null as such, anything else as text."""
    found = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not equals or not name.isidentifier():
            raise ValueError(f"env_kwargs must be key=value, such as obs_type=state, got {word!r}")
        try:
            found[name] = json.loads({"True": "true", "False": "false", "None": "null"}.get(value, value))
        except ValueError:
            plain = value.removeprefix("-").replace(".", "", 1)  # JSON rejects 15. and .5
            found[name] = float(value) if "." in value and plain.isdecimal() else value
    return found
