# This source code is licensed under the MIT license found in the LICENSE file.
"""Fills in the defaults of a training once. Precedence: given options > method > task > network > library."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from functools import reduce
from typing import Any

import numpy as np

from torchrl_koap.data.planner_choices import LEAST_UPDATES
from torchrl_koap.lookup import lookup
from torchrl_koap.modules import PRESETS
from torchrl_koap.modules.execution.execution import Execution, ExecutionConfig
from torchrl_koap.runs.config import ControllerConfig, PlannerConfig, TrainConfig
from torchrl_koap.runs.config_files import fill_in, read_config
from torchrl_koap.runs.device import default_threads, find_precision
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.tasks import HISTORY, HORIZON, REPLAN_INTERVAL, Task
from torchrl_koap.training.method import Method
from torchrl_koap.training.methods import get_method
from torchrl_koap.training.networks import NETWORKS
from torchrl_koap.training.policy_facts import tells_commands

CONTROLLER_UPDATES = 500
HELD_OUT = 0.1  # share of the trajectories that choose the weights of a planner
PLACES = "absolute"  # default preset if decoded actions are positions
FOLLOWED = "delayed"  # default preset if they are targets of state columns, which a robot reaches with a delay
# planner options for recorded data, usually a hundred demonstrations or so: they avoid overfitting
OWN_DATA: dict[str, Any] = {"steps": LEAST_UPDATES, "network": "mlp", "octaves": 0}
OWN_TEMPERATURE = 0.4  # of plans in tasks without an environment, where no modes are counted
PLAN_SECONDS = 0.1  # between plans with feedback, within limits: a new plan starts where the robot lags behind the last


def resolve(config: TrainConfig, task: Task) -> TrainConfig:
    """Looks up every name and fills in every default, in one pass; plugins must have been imported.

    Returns options without None, except ``planner.source`` and the two ways to draw labels that are not used.

    Raises:
        ValueError: for unknown names, and options that exclude each other.
        RunDirectoryError: if ``planner.source`` is no run.
    """
    method = get_method(config.method or task.defaults.method)
    labels = config.labels
    if labels.fraction is None and labels.count is None and not labels.episodes:
        labels = replace(labels, fraction=1.0)
    controller = _controller(config.controller, method, task)
    return replace(
        config,
        task=task.name,
        method=method.name,
        labels=labels,
        planner=_planner(config.planner, method, task),
        controller=controller,
        execution=_execution(config.execution, method, task, controller.preset),
        run=replace(
            config.run,
            threads=config.run.threads or default_threads(),
            precision=find_precision(config.run.precision, config.run.device),
        ),
    )


def _planner(asked: PlannerConfig, method: Method, task: Task) -> PlannerConfig:
    if not method.plans:
        for name, only in {"source": None, "held_out": 0.0, "frames": HISTORY}.items():
            if getattr(asked, name) not in (None, only):
                raise ValueError(f"planner.{name}: method {method.name!r} samples actions and has no planner")
    if asked.source is not None:
        return _taken_over(asked)
    own, usual = dict(task.defaults.planner), OWN_DATA if task.env is None else {"network": "unet"}
    if not method.plans:
        own |= {"frames": HISTORY, "held_out": 0.0}  # with one frame it succeeds less often
    theirs = own.get("network", usual["network"])
    network = asked.network or theirs
    layers = [own if network == theirs else _unsized(own), usual if network == usual["network"] else _unsized(usual)]
    library = {"steps": 12000, "frames": HISTORY, "held_out": HELD_OUT, "network": network}
    return reduce(fill_in, [*layers, lookup(NETWORKS, network, "planner.network"), library], asked)


def _unsized(layer: Mapping[str, Any]) -> dict[str, Any]:
    """Returns defaults without those of their network, for use with another network."""
    return {name: value for name, value in layer.items() if name in ("steps", "frames", "held_out")}


def _taken_over(asked: PlannerConfig) -> PlannerConfig:
    """Returns the planner section of the run that the planner is taken from."""
    if all(getattr(asked, field.name) is not None for field in fields(asked)):  # a resumed run: filled in already
        return asked
    theirs = read_config(RunDirectory(asked.source)).planner
    for name in (field.name for field in fields(asked) if field.name != "source"):
        if getattr(asked, name) not in (None, getattr(theirs, name)):
            raise ValueError(
                f"planner.{name} {getattr(asked, name)!r} was asked for, but that of {asked.source} is"
                f" {getattr(theirs, name)!r}"
            )
    return replace(theirs, source=asked.source)


def _controller(asked: ControllerConfig, method: Method, task: Task) -> ControllerConfig:
    own = dict(task.defaults.controller)
    if method.name != task.defaults.method or own.get("preset") not in method.presets:
        own.pop("preset", None)  # it belongs to the task's default method
    places = tells_commands(task, method) or not (task.delta_actions or task.targets)
    presets, usual = method.presets, method.presets[0]
    if usual == "default":
        presets += (PLACES, FOLLOWED)
        usual = PLACES if places else FOLLOWED if task.targets else usual
    declared = {"columns": method.columns, "steps": method.updates}
    phases = method.plans and (method.phases or method.phases_by_preset)
    if not (phases or method.fit or method.teacher):
        asked = replace(asked, steps=0)  # it has no controller, or only a closed form is fitted
    library = {"preset": usual, "steps": CONTROLLER_UPDATES, "columns": "robot"}
    section = reduce(fill_in, [declared, own, library], asked)
    lookup(PRESETS, section.preset, "preset")
    if section.preset not in presets:
        raise ValueError(f"method {method.name!r} has no preset {section.preset!r}, it has {list(method.presets)}")
    if section.steps == 0 and method.phases and not method.closed_form and (method.plans or method.teacher):
        raise ValueError(f"controller.steps 0: method {method.name!r} has no closed form, nothing would train it")
    return section


def _execution(asked: ExecutionConfig, method: Method, task: Task, preset: str) -> ExecutionConfig:
    own = ({"temperature": OWN_TEMPERATURE} if task.env is None else {}) | dict(task.defaults.execution)
    if not method.plans:
        theirs = () if task.env is None else ("temperature", "replan_interval")  # those of the task's planner
        own = {name: value for name, value in own.items() if name not in theirs} | {"strategy": "open_loop"}
    if asked.strategy == "oracle":
        raise ValueError("execution.strategy 'oracle' reads a simulation: it is for `koap eval`")
    own |= method.execution
    usual = Execution().replaced(**own)
    method.check_execution(asked, usual)
    if asked.on(usual).strategy == "feedback":
        # decoding later actions would need frames beyond the end of the plan
        most = HORIZON + 1 - (method.look_ahead or np.max(PRESETS[preset]["look_ahead"]).item())
        own = {"replan_interval": min(max(REPLAN_INTERVAL, round(PLAN_SECONDS * task.control_hz)), most)} | own
    return ExecutionConfig(**vars(asked.on(Execution().replaced(**own))))
