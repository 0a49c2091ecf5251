# This source code is licensed under the MIT license found in the LICENSE file.
"""Base environment of D3IL's tasks: the order of events in one control step (docs/appendix/d3il.md, Simulator).

One control step of the original, reproduced because policies experience it::

    1. the action becomes a new command
    2. observation, success and failure are read from the state *before* this step's substeps
    3. 35 substeps of 1 ms (Stacking: 30): the controller tracks the command
    4. the mode is updated from the state after the substeps

so the observation is one control step old, and ``done`` comes one step after the state that caused it.
"""

from __future__ import annotations

import abc
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_koap import keys
from torchrl_koap.envs.contexts import check_contexts, draw_contexts, poses_of
from torchrl_koap.envs.mujoco import controller
from torchrl_koap.envs.mujoco.rendering import Renderer
from torchrl_koap.envs.mujoco.scene import compile_scene
from torchrl_koap.envs.mujoco.simulation import SimulationBatch
from torchrl_koap.tasks import Task, get_task


class ManipulationEnv(EnvBase):
    """Simulates a batch of episodes of a D3IL task, with partial resets and partial steps.

    A task declares the class attributes and implements the hooks :meth:`_scene`, :meth:`_command`, :meth:`_observe`,
    :meth:`_check` and :meth:`_update_mode`; ``rows`` are indices of environments.

    A task with objects has *contexts*, their poses when an episode starts (:mod:`torchrl_koap.envs.contexts`). They are
    drawn at random at every reset, or given by ``reset(contexts=...)``.

    The tables of the tasks add to these keys::

        success     [n, 1] bool               latched: the first outcome that is observed stays until the reset
        collision   [n, 1] bool               likewise, if an episode can end by one
        context     [n, objects, 3] dtype     start of the objects, x, y (m), yaw (rad), if there are any
        reward      [n, 1] dtype              1 where ``success`` else 0
        terminated  [n, 1] bool               ``success`` or ``collision``; truncated: after ``max_steps`` steps

    Args:
        num_envs (int): number of environments, the batch size.
        num_threads (int): threads that advance them; results do not depend on it.
        max_steps (int, optional): control steps after which an episode is truncated. Default: the task's.
        seed (int, optional): seed of the random contexts.
        device (torch.device, optional): device of returned tensors; the physics runs on the CPU.
        dtype (torch.dtype): floating type of observation, action and reward.

    Keyword Args:
        task (Task, optional): a variant of the class's own task.

    Raises:
        ValueError: for sizes below 1 or a non-floating dtype; in ``reset`` for contexts of a wrong shape or out of
            range, in ``step`` for actions of a wrong shape or that are not finite.
        RuntimeError: in ``step`` before the first reset.

    Examples:
        >>> from torchrl_koap.envs import AvoidingEnv  # a task of this base
        >>> env = AvoidingEnv(num_envs=2)
        >>> env.task.name, env.reset()["success"].flatten().tolist()
        ('avoiding', [False, False])
    """

    TASK: str  # name of the task
    START_JOINTS: tuple[float, ...] = (0.0,) * 7  # after a reset (rad)
    START_HEIGHT = 0.0  # of the free bodies (m)
    ACTION_BOUND: Any = (-0.012, 0.012)  # least and greatest values of random actions; actions outside are executed too
    MODE_ENTRIES: int | None = 1  # number of entries of ``mode``; None: one per object
    MODE_VALUES: int | None = None  # its entries are int64, -1 (undecided) to this - 1; None: bool flags
    COLLIDES = False  # whether an episode can end by a collision
    SUBSTEPS = 35  # physics steps (1 ms) per control step
    COMMAND_DIM = 7  # numbers that make up a command
    RESET_WIDTH = controller.FINGER_RESET  # finger target during the reset's substep (m)

    def __init__(
        self,
        num_envs: int = 1,
        num_threads: int = 1,
        max_steps: int | None = None,
        seed: int | None = None,
        device: torch.device | str | None = None,
        dtype: torch.dtype = torch.float32,
        *,
        task: Task | None = None,
    ):
        task = get_task(self.TASK) if task is None else task
        max_steps = task.max_steps if max_steps is None else max_steps
        for name, value in (("num_envs", num_envs), ("num_threads", num_threads), ("max_steps", max_steps)):
            if not isinstance(value, int) or value < 1:
                raise ValueError(f"{name} must be an integer of at least 1, got {value!r}")
        if not isinstance(dtype, torch.dtype) or not dtype.is_floating_point:
            raise ValueError(f"dtype must be a floating torch.dtype, got {dtype!r}")
        super().__init__(device=device, batch_size=[num_envs])
        self.task, self.max_steps = task, max_steps
        self.sims: Any = self._simulations(num_envs, num_threads)
        self._dtype = dtype
        self._episode = episode = self._episode_arrays(num_envs)
        self._observation, self._commands, self._mode = episode["observation"], episode["commands"], episode["mode"]
        self._success, self._collision, self._seen = episode["success"], episode["collision"], episode["seen"]
        self._steps, self._ready, self._contexts = episode["steps"], episode["ready"], episode["contexts"]
        self._renderer: Renderer | None = None
        self._make_specs()
        self._set_seed(seed)

    def _simulations(self, num_envs: int, num_threads: int) -> Any:
        """Returns the simulations; tasks with another arm than D3IL's override it."""
        return SimulationBatch(compile_scene(self._scene()), num_envs, num_threads)

    def _episode_arrays(self, num_envs: int) -> dict[str, np.ndarray]:
        """Returns the state of running episodes outside the simulation, a row per environment."""
        entries = len(self.task.objects) if self.MODE_ENTRIES is None else self.MODE_ENTRIES
        return {
            "observation": np.zeros((num_envs, self.task.observation_dim)),
            "commands": np.zeros((num_envs, self.COMMAND_DIM)),
            "mode": np.zeros((num_envs, entries), dtype=bool if self.MODE_VALUES is None else np.int64),
            "contexts": np.zeros((num_envs, len(self.task.objects), 3)),
            "success": np.zeros(num_envs, dtype=bool),
            "collision": np.zeros(num_envs, dtype=bool),
            "seen": np.zeros((num_envs, 2), dtype=bool),  # success and failure of the present state, reported next step
            "steps": np.zeros(num_envs, dtype=np.int64),
            "ready": np.zeros(num_envs, dtype=bool),
        }

    def _make_specs(self) -> None:
        shape, device, entries = self.batch_size, self.device, self._mode.shape[1]
        flag = {"n": 1, "shape": (*shape, 1), "device": device, "dtype": torch.bool}
        leaves = {
            keys.OBSERVATION: Unbounded((*shape, self.task.observation_dim), device=device, dtype=self._dtype),
            keys.SUCCESS: Binary(**flag),
            keys.MODE: Binary(**flag | {"n": entries, "shape": (*shape, entries)}),
        }
        if self.MODE_VALUES is not None:
            leaves[keys.MODE] = Bounded(-1, self.MODE_VALUES - 1, (*shape, entries), device=device, dtype=torch.int64)
        if self.COLLIDES:
            leaves[keys.COLLISION] = Binary(**flag)
        if self.task.objects:
            leaves[keys.CONTEXT] = Unbounded((*shape, *self._contexts.shape[1:]), device=device, dtype=self._dtype)
        self.observation_spec = Composite(leaves, shape=shape)
        size = (*shape, self.task.action_dim)
        bounds = (torch.as_tensor(bound, dtype=self._dtype, device=device) for bound in self.ACTION_BOUND)
        self.action_spec = Bounded(*(bound.expand(size) for bound in bounds), size, device=device, dtype=self._dtype)
        self.reward_spec = Bounded(0.0, 1.0, (*shape, 1), device=device, dtype=self._dtype)
        done = Categorical(2, (*shape, 1), device=device, dtype=torch.bool)
        self.done_spec = Composite({name: done.clone() for name in ("done", "terminated", "truncated")}, shape=shape)

    def _begin(self, rows: np.ndarray) -> None:
        """Writes the first command into ``self._commands[rows]`` after a reset: stay, hand pointing down."""
        self._commands[rows, :3] = self.sims.tcp_position[rows]
        self._commands[rows, 3:] = (0.0, 1.0, 0.0, 0.0)

    def _scene(self) -> Any:
        """Returns the scene of the task, an ``mjcf.RootElement``."""
        raise NotImplementedError

    def _command(self, rows: np.ndarray, action: np.ndarray) -> None:
        """Turns actions [len(rows), act] into new commands ``self._commands[rows]``; by default they are changes."""
        self._commands[rows, : action.shape[1]] += action

    @abc.abstractmethod
    def _observe(self, rows: np.ndarray) -> np.ndarray:
        """Returns the observation [len(rows), obs] of the present state and command."""

    @abc.abstractmethod
    def _check(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns whether the present state is a success, and whether it is a failure, each bool [len(rows)]."""

    @abc.abstractmethod
    def _update_mode(self, rows: np.ndarray) -> None:
        """Updates ``self._mode[rows]`` from the present state."""

    def _advance(self, rows: np.ndarray) -> None:
        """Runs the physics of one control step under ``self._commands[rows]``."""
        self.sims.track_pose(rows, self._commands, self.SUBSTEPS)

    def _set_seed(self, seed: int | None) -> None:
        self.generator = np.random.default_rng(seed)

    def _rows(self, tensordict: TensorDictBase | None, key: str) -> np.ndarray:
        mask = None if tensordict is None else tensordict.get(key, None)
        if mask is None:
            return np.arange(self.batch_size[0])
        return mask.reshape(self.batch_size[0], -1).any(-1).cpu().numpy().nonzero()[0]

    def _reset(self, tensordict: TensorDictBase | None = None, *, contexts=None) -> TensorDictBase:
        rows = self._rows(tensordict, "_reset")
        self._draw_contexts(rows, contexts)
        self._start(rows)
        self._begin_episode(rows)
        return self._leaves()

    def _start(self, rows: np.ndarray) -> None:
        """Puts the simulations into the start states of ``self._contexts[rows]``."""
        free = [not body.still for body in self.task.bodies]
        places = poses_of(self._contexts[rows][:, free], self.START_HEIGHT) if any(free) else None
        self.sims.reset(rows, np.asarray(self.START_JOINTS), places, width=self.RESET_WIDTH)

    def _draw_contexts(self, rows: np.ndarray, contexts) -> None:
        if contexts is not None:
            contexts = check_contexts(self.task, contexts)
            if len(contexts) != len(rows):
                raise ValueError(f"one context per environment to reset: wanted {len(rows)}, got {len(contexts)}")
        elif self.task.objects:
            contexts = draw_contexts(self.task, len(rows), self.generator)
        else:
            return
        self._contexts[rows] = contexts

    def _begin_episode(self, rows: np.ndarray) -> None:
        self._success[rows] = self._collision[rows] = False
        self._mode[rows] = False if self.MODE_VALUES is None else -1
        self._steps[rows] = 0
        self._ready[rows] = True
        self._begin(rows)
        self._observation[rows] = self._observe(rows)
        self._seen[rows] = np.stack(self._check(rows), axis=1)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        rows = self._rows(tensordict, "_step")
        self._command(rows, self._checked_action(tensordict, rows))
        success, failure = self._seen[rows].T
        undecided = ~(self._success[rows] | self._collision[rows])
        self._success[rows] |= undecided & success
        self._collision[rows] |= undecided & failure & ~success  # both at once count as success
        self._observation[rows] = self._observe(rows)

        self._advance(rows)
        self._steps[rows] += 1
        self._update_mode(rows)
        self._seen[rows] = np.stack(self._check(rows), axis=1)
        return self._stepped(rows)

    def _stepped(self, rows: np.ndarray) -> TensorDictBase:
        reward = np.zeros_like(self._success)
        reward[rows] = self._success[rows]
        return self._leaves().set("reward", self._tensor(reward[:, None], self._dtype))

    def _checked_action(self, tensordict: TensorDictBase, rows: np.ndarray) -> np.ndarray:
        action = tensordict.get(keys.ACTION, None)
        wanted = (*self.batch_size, self.task.action_dim)
        if action is None or tuple(action.shape) != wanted:
            came = "none" if action is None else f"shape {list(action.shape)}"
            raise ValueError(f"{keys.ACTION!r} must have shape {list(wanted)} [num_envs, action], got {came}")
        action = action.detach().to("cpu", torch.float64).numpy()[rows]
        bad = ~np.isfinite(action).all(-1)
        if bad.any():
            first = f"{action[bad][0].tolist()} for environment {rows[bad][0]} ({bad.sum()} of {len(rows)} concerned)"
            raise ValueError(f"{keys.ACTION!r} must be finite, got {first}")
        if not self._ready[rows].all():
            raise RuntimeError("step() before the first reset() of these environments")
        return action

    def _leaves(self) -> TensorDictBase:
        flags = {keys.SUCCESS: self._success, "done": self.over, "terminated": self._success | self._collision}
        flags["truncated"] = self._steps >= self.max_steps
        if self.COLLIDES:
            flags[keys.COLLISION] = self._collision
        leaves = {name: self._tensor(flag[:, None]) for name, flag in flags.items()}
        leaves[keys.OBSERVATION] = self._tensor(self._observation, self._dtype)
        leaves[keys.MODE] = self._tensor(self._mode)
        if self.task.objects:
            leaves[keys.CONTEXT] = self._tensor(self._contexts, self._dtype)
        return TensorDict(leaves, batch_size=self.batch_size, device=self.device)

    def _tensor(self, array: np.ndarray, dtype: torch.dtype | None = None) -> torch.Tensor:
        return torch.tensor(array, dtype=dtype, device=self.device)  # a copy: the arrays change with the next step

    @property
    def commands(self) -> np.ndarray:
        """Present commands in float64: TCP position (m) and quaternion [n, 7]; Stacking: joints and gripper [n, 8]."""
        return self._commands.copy()

    def get_state(self, index: int) -> dict:
        """Returns the full state of one environment, for :meth:`set_state` of any environment of the same task."""
        rows = {name: array[index].copy() for name, array in self._episode.items()}
        return {"simulation": self.sims.get_state(index)} | rows

    def set_state(self, index: int, state: dict) -> None:
        """Restores what :meth:`get_state` returned; the episode then continues bit for bit."""
        self.sims.set_state(index, state["simulation"])
        for name, array in self._episode.items():
            array[index] = state[name]

    def simulate_actions(self, actions: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Simulates action sequences from the present state of the environments ``rows`` and restores it.

        Sequences ``[m, len(rows), k, act]`` lead to observations ``[m, len(rows), k, obs]``. Entry ``k`` is the state
        after actions 0 to ``k``; :meth:`step` observes it one control step later.
        """
        present = {row: self.get_state(row) for row in rows}
        observations = np.empty((*actions.shape[:3], self.task.observation_dim))
        for sequence, observed in zip(actions, observations, strict=True):
            for step in range(actions.shape[2]):
                self._command(rows, sequence[:, step])
                self._advance(rows)
                observed[:, step] = self._observe(rows)
            for row, state in present.items():
                self.set_state(row, state)
        return observations

    @property
    def over(self) -> np.ndarray:
        """Whether each episode is decided or has used up its steps, bool [n]."""
        return self._success | self._collision | (self._steps >= self.max_steps)

    def render(self, index: int = 0, width: int = 480, height: int = 480, camera: str | None = None) -> np.ndarray:
        """Draws one environment, uint8 [height, width, 3], by default with the task's ``scene.camera`` or ``"cage"``.

        Cameras are ``"front"``, ``"cage"`` (D3IL's) and ``"wrist"``; Scooping's ``"third_person"`` and ``"front"``.

        Raises:
            IndexError: for an environment outside the batch.
            RuntimeError: if no OpenGL library can be used.
            ValueError: for an unknown camera or a size below 1.
        """
        if self._renderer is None or self._renderer.size != (width, height):
            renderer = Renderer(self.sims.model, width, height)  # an error leaves the old one as it is
            if self._renderer is not None:
                self._renderer.close()
            self._renderer = renderer
        return self._renderer.render(self.sims.data[index], camera or self.task.scene.camera or "cage")

    def close(self, **kwargs) -> None:
        """Frees graphics memory, if any was used, and the threads."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        self.sims.close()
        super().close(**kwargs)

    def raw_log(self) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Returns what D3IL's recorder logs for the last control step: arrays of the robot, and poses of the objects.

        Arrays ``[n, ...]`` include the command ``des_c_pos`` (m); poses are ``[n, objects, 7]`` (m, quaternion).
        """
        robot, poses = self.sims.logged()
        pose = {"des_c_pos": self.commands[:, :3]} if self.COMMAND_DIM == 7 else {}  # joints are in the log already
        return robot | pose, poses
