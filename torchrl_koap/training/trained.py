# This source code is licensed under the MIT license found in the LICENSE file.
"""A finished training: its networks with their weights, and what they were trained on."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import nn

from torchrl_koap.data import open_dataset
from torchrl_koap.data.formats import find_format
from torchrl_koap.data.label_budget import LabelReport, subsample_trajectories
from torchrl_koap.data.ted import CAMERAS, source_names
from torchrl_koap.files import some
from torchrl_koap.modules import Execution, ExecutionConfig, PlanningPolicy, StatePlanner, make_policy
from torchrl_koap.modules.execution.followers import Follower
from torchrl_koap.runs.config import TrainConfig, given_options
from torchrl_koap.runs.config_files import from_json, read_config, to_json, versions
from torchrl_koap.runs.plugins import load_plugins
from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError, find_run, no_data
from torchrl_koap.runs.weights import CheckpointError, load_parts, load_tensors, load_weights, save_tensors
from torchrl_koap.tasks import Task
from torchrl_koap.tasks.registry import task_from
from torchrl_koap.training.datasets import fingerprint, within_budget
from torchrl_koap.training.method import Method
from torchrl_koap.training.methods import get_method
from torchrl_koap.training.networks import build_controller, build_planner
from torchrl_koap.training.policy_facts import controller_data, policy_facts, state_reader, with_commands
from torchrl_koap.vision import Observer, Projection
from torchrl_koap.vision.encoder import load_cameras

FORMAT, VERSION = "torchrl_koap policy", 2


@dataclass(frozen=True)
class Trained:
    """Result of a training: networks in evaluation mode, with task and options.

    Args:
        task (Task): the task.
        config (TrainConfig): its options, with all defaults filled in.
        planner (StatePlanner, optional): None for a method that samples actions, or if only a controller was trained.
        controller (nn.Module, optional): the controller, or the network that samples actions; None if only a planner
            was trained.
        results (mapping): last losses, labels used and results of a closed form, as in ``summary.json``.
        held_out (tuple of int): trajectories that did not train the planner; its score on them chose its weights.
        folder (Path, optional): the run directory or file that it was loaded from.
        cameras (mapping): projection of every camera whose embeddings are columns of the task.

    Examples:
        >>> from torchrl_koap import Trained
        >>> trained = Trained.load("pretrained:avoiding")  # or the folder of a run of yours
        >>> trained.task.name, trained.method.name, trained.planner.horizon
        ('avoiding', 'koap', 14)
    """

    task: Task
    config: TrainConfig
    planner: StatePlanner | None
    controller: nn.Module | None
    results: Mapping[str, Any] = field(default_factory=dict)
    held_out: tuple[int, ...] = ()
    folder: Path | None = None
    cameras: Mapping[str, Projection] = field(default_factory=dict)

    def __repr__(self) -> str:  # without the networks, which fill pages
        where = self.folder and str(self.folder)
        return f"Trained(task={self.task.name!r}, method={self.config.method!r}, folder={where!r})"

    @classmethod
    def load(cls, where: str | Path, *, plugins: Sequence[str] = ()) -> Trained:
        """Loads a run directory, ``"pretrained:NAME"``, or a file of :meth:`save`.

        Plugins are modules that register the task or method, or define the network that embeds frames. A run directory
        also imports those that it names, a file does not. A plugin file replaces a recorded one of the same name.

        Raises:
            RunDirectoryError: if the folder is not a finished run.
            CheckpointError: if weights, or the file, are missing, damaged, of another task or of other options.
            PluginError: if a plugin cannot be imported.
        """
        load_plugins(plugins)
        path = find_run(where)
        trained = cls._from_file(path, plugins) if path.is_file() else cls._from_folder(path, plugins)
        for projection in trained.cameras.values():
            projection.find_network(plugins)
        return trained

    @classmethod
    def _from_folder(cls, path: Path, plugins: Sequence[str]) -> Trained:
        run = RunDirectory(path)
        config, content = read_config(run), run.read_json("config.json")
        given = {Path(name).name for name in plugins}
        load_plugins([name for name in config.run.plugins if Path(name).name not in given])
        try:
            task = task_from(config.task, content.get("task_definition"))
            planner, controller = build_networks(task, config)
        except (KeyError, TypeError, ValueError) as error:
            problem = f"an entry {error} is missing" if isinstance(error, KeyError) else error
            raise RunDirectoryError(f"{path / 'config.json'} cannot be used: {problem}") from error
        if content.get("planner_only"):
            raise RunDirectoryError(f"{path} holds a planner for other runs (planner.source), not a policy")
        if not (path / "summary.json").exists():  # it is written last
            how = f"`koap train --out {shlex.quote(str(path))} --resume`"
            raise RunDirectoryError(f"the training of {path} is not finished (no summary.json): resume it with {how}")
        for name, module in {"planner": planner, "controller": controller}.items():
            if module is not None:
                load_weights(path / f"{name}.safetensors", module, facts_of(name, task, config))
        results = run.read_json("summary.json")
        held_out, cameras = tuple(content.get("held_out_episodes") or ()), load_cameras(path / CAMERAS)
        return cls(task, config, planner, controller, results, held_out, path, cameras)

    @classmethod
    def _from_file(cls, path: Path, plugins: Sequence[str]) -> Trained:
        tensors, about = load_tensors(path)
        if about.get("format") != FORMAT:
            raise CheckpointError(f"{path} is not a policy that Trained.save() wrote")
        if about.get("version") != VERSION:
            raise CheckpointError(f"{path} is a policy of format {about.get('version')}, this version reads {VERSION}")
        try:
            config = from_json(TrainConfig, about["config"], path)
            task = task_from(config.task, about["task_definition"])
            planner, controller = build_networks(task, config)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            problem = f"entry {error} is missing" if isinstance(error, KeyError) else error
            needs = [name for name in about.get("config", {}).get("run", {}).get("plugins", ()) if name not in plugins]
            hint = f"; it was made with the plugins {', '.join(map(str, needs))}" if needs else ""
            raise CheckpointError(f"{path} cannot be built: {problem}{hint}") from error
        load_parts(path, tensors, {"planner": planner, "controller": controller})
        code = {Path(facts["network"].rpartition(":")[0]).name for facts in about.get(CAMERAS, {}).values()}
        code -= {"", *(Path(name).name for name in plugins)}
        if code:  # a file from elsewhere must not choose which code runs
            raise CheckpointError(f"{path} embeds frames with code of {some(sorted(code))}: name it in plugins")
        results = {"command_ranges": about.get("command_ranges")}
        cameras = {
            name: Projection(tensors[f"{CAMERAS}.{name}.mean"], tensors[f"{CAMERAS}.{name}.components"], facts)
            for name, facts in about.get(CAMERAS, {}).items()
        }
        return cls(task, config, planner, controller, results, folder=path, cameras=cameras)

    def save(self, path: str | Path) -> Path:
        """Writes networks and options atomically to one file, from which :meth:`load` restores them without data.

        Raises:
            IsADirectoryError: if the path is a folder.
            ValueError: if only a planner or a controller was trained, or for a planner given to
                :func:`~torchrl_koap.fit` with options that a file does not record, such as its solver.
        """
        self._check_parts()
        self._check_planner()
        path = Path(path)
        if path.is_dir():
            raise IsADirectoryError(f"{path} is a folder; a policy is one file, such as {path / 'policy.safetensors'}")
        networks: dict[str, nn.Module | None] = {"planner": self.planner, "controller": self.controller}
        networks |= {f"{CAMERAS}.{name}": projection for name, projection in self.cameras.items()}
        tensors = {
            f"{name}.{key}": value
            for name, module in networks.items()
            if module is not None
            for key, value in module.state_dict().items()
        }
        about = {
            "format": FORMAT,
            "version": VERSION,
            "config": to_json(self.config),
            "task_definition": self.task.definition(),
            "command_ranges": self.results.get("command_ranges"),
            CAMERAS: {name: projection.about for name, projection in self.cameras.items()},
            "versions": versions(),
        }
        save_tensors(path, tensors, about)
        return path

    @property
    def method(self) -> Method:
        """The method."""
        return get_method(self.config.method)

    @property
    def columns(self) -> tuple[int, ...]:
        """State columns that the controller reads."""
        return self.task.controller_columns(self.config.controller.columns)

    @property
    def execution(self) -> Execution:
        """Default options for turning plans into actions."""
        return self.config.execution.on(Execution())

    def policy(
        self, execution: Execution | ExecutionConfig | None = None, *, follower: Follower | None = None
    ) -> PlanningPolicy:
        """Makes a policy from the networks; it maps observations to one action per control step.

        Args:
            execution (Execution or ExecutionConfig, optional): how plans become actions. Fields that are None keep
                the values of the training.

        Keyword Args:
            follower (Follower, optional): follows plans in place of the controller.

        Returns:
            PlanningPolicy: in evaluation mode. A :class:`~torchrl_koap.modules.PolicyEnv` passes it the past that it
            reads; an :class:`~torchrl_koap.modules.Agent` stores that itself.

        Raises:
            ValueError: as :func:`~torchrl_koap.modules.make_policy`, for a plan strategy with a method that samples
                actions, or if only a planner or a controller was trained.
        """
        if not isinstance(execution, Execution):
            execution = given_options(execution, ExecutionConfig).on(self.execution)
        self._check_parts()
        reads = state_reader(self.task, self.config.controller)
        facts = policy_facts(self.task, reads=reads, ranges=self.results.get("command_ranges"))
        facts["observe"] = Observer(self.task, self.cameras) if self.cameras else None
        if self.method.plans:
            return make_policy(self.planner, self.controller, **facts, execution=execution, follower=follower)
        self.method.check_execution(execution, self.execution)
        if follower is not None:
            raise ValueError(f"follower: method {self.method.name!r} samples actions and makes no plans to follow")
        return make_policy(self.controller, **facts, execution=execution)

    def _check_parts(self) -> None:
        missing = [name for name in ("planner", "controller") if getattr(self, name) is None]
        if self.method.plans and missing:
            raise ValueError(f"a policy needs planner and controller: no {missing[0]} was trained here")

    def _check_planner(self) -> None:
        """Raises a ValueError if :meth:`load` would build another planner than this one, which was given to ``fit``."""
        if self.planner is None:
            return
        with torch.random.fork_rng(devices=[]):
            both = self.planner, build_planner(self.task, self.config.planner)
        names = ("horizon", "relative", "solver", "num_steps")
        own, built = ({name: vars(each)[name] for name in names} for each in both)
        shapes, wanted = ({key: value.shape for key, value in each.state_dict().items()} for each in both)
        if own != built or shapes != wanted:
            differ = [f"{name} {own[name]!r}" for name in names if own[name] != built[name]] or ["other layers"]
            raise ValueError(f"planner: it has {', '.join(differ)}, which a file does not record: it cannot be saved")

    def data(self, dataset: str | None = None) -> TensorDictBase:
        """Reads the demonstrations of the training with all labels; ``dataset`` is their folder if it has moved.

        Raises:
            RunDirectoryError: if they are missing.
        """
        where = dataset or self.config.dataset
        if where is None or not Path(where).is_dir() and find_format(where) is None:
            raise no_data(where, self.folder)
        return open_dataset(where, task=self.task)[0]

    def names(self, data: TensorDictBase, dataset: str | None = None) -> dict[int, str]:
        """Returns the source of each trajectory of :meth:`data`, by number; empty if the data set records none."""
        numbers = data["episode"].unique_consecutive().tolist()
        return dict(zip(numbers, source_names(dataset or self.config.dataset or ""), strict=False))

    def seen(self, data: TensorDictBase) -> TensorDictBase:
        """Converts flat data ``[N]`` to what the controller reads and predicts."""
        return controller_data(self.task, self.config.controller, with_commands(self.task, data))

    def hide_labels(self, data: TensorDictBase) -> tuple[TensorDictBase, LabelReport]:
        """Hides all labels of :meth:`data` that the training did not see (NaN actions); also returns a report.

        Raises:
            RunDirectoryError: if they are not the demonstrations of the training.
        """
        hidden, report = within_budget(self.task, self.config, data)
        if "labels" not in self.results:
            where = self.folder or "a training in memory"
            wanted = "wanted a run of `koap train`, whose summary.json has the entry 'labels'"
            raise RunDirectoryError(f"{where} does not record which labels were seen: {wanted}")
        recorded = self.results["labels"]
        used = fingerprint(subsample_trajectories(hidden, self.config.labels.trajectories))
        trained_on = self.folder and RunDirectory(self.folder).read_json("config.json").get("data")
        if {name: vars(report).get(name) for name in recorded} != recorded or trained_on not in (None, used):
            raise RunDirectoryError(
                f"the given data set is not the one that {self.folder} was trained on: its trajectories or labels"
                " differ; train again with it"
            )
        return hidden, report


def build_networks(task: Task, config: TrainConfig) -> tuple[StatePlanner | None, nn.Module]:
    """Builds the networks of a resolved configuration without weights, in evaluation mode.

    Returns the planner (None for a method that samples actions), and the network that controls or samples actions.

    Raises:
        ValueError: for unknown names, or networks that cannot read the task's state.
    """
    method = get_method(config.method)
    if not method.plans:
        return None, method.build(task, config.planner).eval()
    return build_planner(task, config.planner).eval(), build_controller(task, method, config.controller).eval()


def facts_of(part: str, task: Task, config: TrainConfig) -> dict[str, Any]:
    """Returns the network options that a weights file of ``"planner"`` or ``"controller"`` records."""
    planner = {f"planner.{name}": getattr(config.planner, name) for name in ("network", "width", "frames")}
    if part == "planner":
        return {"task": task.name} | planner
    facts: dict[str, Any] = {"task": task.name, "method": config.method}
    if not get_method(config.method).plans:
        return facts | planner
    return facts | {f"controller.{name}": getattr(config.controller, name) for name in ("preset", "columns")}
