# This source code is licensed under the MIT license found in the LICENSE file.
"""The loop that trains planners and controllers: logged, checkpointed, resumable bit for bit."""

from __future__ import annotations

import contextlib
import math
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import CudaGraphModule
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate

from torchrl_koap.runs.config import PlannerConfig
from torchrl_koap.runs.progress import progress_bar, show_losses
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.runs.weights import CheckpointError
from torchrl_koap.training.best_weights import BestWeights
from torchrl_koap.training.checkpoints import load_training_state, save_training_state

CHECKPOINT_EVERY = 500  # updates
WARMUP = 100  # updates until the learning rate reaches its peak
TIMES = 5.0  # of the root mean square length; mini-batch gradients vary by about a factor of two
SETTLED = 100  # updates until the mean square is reliable
WEIGHT_DECAY = 1e-4  # decoupled; of all denoisers
AVERAGE_EVERY = 4  # updates between two steps of the average, which reads and writes every weight


def warmup_cosine(step: int, num_steps: int, warmup: int) -> float:
    """Returns the share of the peak learning rate at update ``step`` (from 0): linear warm-up, half a cosine to 0."""
    return min(1.0, (step + 1) / max(warmup, 1)) * 0.5 * (1 + math.cos(math.pi * step / num_steps))


def moving_average(loss_module: nn.Module, num_steps: int) -> SoftUpdate:
    """Makes the moving average, in a loss's ``target_*_params``, that is used after training.

    :func:`train_phase` steps it. The decay per update is ``1 - 10 / (num_steps + 10)``, at least 0.84, at most 0.998.
    """
    decay = min(0.998, 1 - 10 / (num_steps + 10))
    return SoftUpdate(loss_module, eps=max(0.5, decay**AVERAGE_EVERY))  # SoftUpdate warns below 0.5


class DivergedError(RuntimeError):
    """A loss that became NaN or infinite."""


def train_phase(
    phase: str,
    loss_module: nn.Module,
    sample: Callable[[], TensorDictBase],
    *,
    num_steps: int,
    learning_rate: float,
    weight_decay: float = 0.0,
    target_update: SoftUpdate | None = None,
    best: BestWeights | None = None,
    run: RunDirectory | None = None,
    logger: Any = None,
    log_every: int = 50,
    resume: bool = False,
    replay: bool = False,
    progress: Callable[[int, dict[str, float]], None] | None = None,
) -> dict[str, float]:
    """Minimises the sum of all ``loss_*`` entries of a TorchRL ``LossModule`` with AdamW, in ``num_steps`` updates.

    :func:`warmup_cosine` schedules the learning rate. Gradients far longer than earlier ones are clipped
    (:class:`AdaptiveClipping`). ``target_update`` is stepped every fourth update; ``best`` scores averages, keeps good
    ones and ends training early. ``sample`` returns a batch, drawn by torch's global generator. ``run``, ``logger`` and
    ``resume`` are those of :class:`Phases`; on a CPU a training resumes bit for bit. ``replay`` records an update once
    as a CUDA graph: the loss must take the same path for every batch, as denoising losses do. ``progress`` is called
    with the number of updates done and the last logged values. These are returned, with ``updates`` and
    ``iterations_per_second`` of the whole phase.

    Raises:
        DivergedError: if a loss is not finite when logged, or a parameter is not when a checkpoint is due; the message
            names step and term. The last checkpoint is kept.
        CheckpointError: if the checkpoint is damaged or of another model.
    """
    device = next(loss_module.parameters()).device
    replay = replay and device.type == "cuda"
    # fused AdamW is the fastest on CPU and CUDA, and its state is plain tensors
    optimizer = torch.optim.AdamW(
        loss_module.parameters(), learning_rate, weight_decay=weight_decay, fused=True, capturable=replay
    )
    checkpoint = None if run is None else run.path / "checkpoints" / f"{phase}.safetensors"
    clip = AdaptiveClipping(loss_module.parameters(), decay=optimizer.param_groups[0]["betas"][1]).to(device)
    state = nn.ModuleDict({"loss": loss_module, "limit": clip} | ({} if best is None else {"best": best}))
    start = 0
    if resume and checkpoint is not None:
        if checkpoint.exists():
            start = load_training_state(checkpoint, state, optimizer)["step"]
            if start > num_steps:
                raise CheckpointError(f"{checkpoint} is at step {start}, this training has {num_steps}")
        run.rewind_metrics(phase, start)
    values: dict[str, float] = run.last_metrics(phase) if start else {}
    device_rate = torch.tensor(learning_rate, device=device)  # a CUDA graph reads tensors only

    def ends(step: int) -> bool:
        return step == num_steps or (best is not None and best.finished(step))

    def update(batch: TensorDictBase) -> TensorDictBase:
        losses = loss_module(batch)
        terms = losses.select(*(key for key in losses.keys() if key.startswith("loss_")))
        sum(terms.values()).backward()
        clip()
        optimizer.step()
        optimizer.zero_grad()
        return terms.detach()

    if replay:
        with warnings.catch_warnings():  # CudaGraphModule warns that it takes tensordicts out of torch's pytrees
            warnings.simplefilter("ignore", UserWarning)
            update = CudaGraphModule(update)
    done, began = start, time.perf_counter()
    log = _Log(phase, run, logger, start, began)
    ended = ends(done)
    while not ended:
        rate = learning_rate * warmup_cosine(done, num_steps, WARMUP)
        for group in optimizer.param_groups:
            group["lr"] = device_rate.fill_(rate) if replay else rate
        with _interrupts_let_through():
            terms = update(sample())
            done += 1
            scored = best is not None and (done % best.every == 0 or done == num_steps)
            if target_update is not None and (done % AVERAGE_EVERY == 0 or done == num_steps):
                target_update.step()
            scores = {} if best is None else best.check(done) if scored else best.kept()
        ended = ends(done)
        if scored or done % log_every == 0 or ended:
            values = log(done, terms, rate, scores)
        if progress is not None:
            progress(done, values)
        if checkpoint is not None and (done % CHECKPOINT_EVERY == 0 or ended):
            if not all(parameter.isfinite().all() for parameter in loss_module.parameters()):
                raise DivergedError(f"{phase}: parameters are not finite at step {done}; lower the learning rate")
            save_training_state(checkpoint, state, optimizer, {"phase": phase, "step": done})
    values["updates"] = done
    if done > start:
        values["iterations_per_second"] = (done - start) / (time.perf_counter() - began)
    return values


@dataclass
class _Log:
    """Writes the values of a phase, and measures its speed between two calls."""

    phase: str
    run: RunDirectory | None
    logger: Any
    step: int  # of the last call
    called: float  # its time

    def __call__(self, step: int, terms: TensorDictBase, rate: float, scores: Mapping[str, float]) -> dict[str, float]:
        values = {key: value.item() for key, value in terms.items()}
        bad = [key for key, value in values.items() if not math.isfinite(value)]
        if bad:
            raise DivergedError(f"{self.phase}: {', '.join(bad)} is not finite at step {step}; lower the learning rate")
        now = time.perf_counter()
        speed = (step - self.step) / max(now - self.called, 1e-9)
        self.step, self.called = step, now
        values |= {"learning_rate": rate, "iterations_per_second": speed, **scores}
        if self.run is not None:
            self.run.log(self.phase, step, values)
        if self.logger is not None:
            for key, number in values.items():
                self.logger.log_scalar(f"{self.phase}/{key}", number, step=step)
        return values


@dataclass
class Phases:
    """Runs the phases of a training with shared options and a progress bar each, and counts their updates.

    Args:
        run (RunDirectory, optional): where metrics and checkpoints are written. Default: nowhere.
        logger (optional): a TorchRL logger.
        resume (bool): resume from the checkpoints of the run.
    """

    run: RunDirectory | None = None
    logger: Any = None
    resume: bool = False
    updates: int = 0

    def __call__(self, name: str, loss: nn.Module, sample: Callable, *, num_steps: int, **options) -> dict[str, float]:
        """Runs :func:`train_phase`."""
        self.updates += num_steps
        shared = {"run": self.run, "logger": self.logger, "resume": self.resume}
        with progress_bar(num_steps, name, smoothing=0.05, mininterval=0.5) as bar:
            return train_phase(name, loss, sample, num_steps=num_steps, progress=show_losses(bar), **shared, **options)

    def denoise(
        self, name: str, loss: nn.Module, sample: Callable, section: PlannerConfig, *, best: BestWeights | None = None
    ) -> dict[str, float]:
        """Trains a denoiser with a planner's options; the loss has the averaged parameters at the end."""
        steps, average = section.steps, moving_average(loss, section.steps)
        options = {"learning_rate": section.learning_rate, "weight_decay": WEIGHT_DECAY, "replay": True}
        return self(name, loss, sample, num_steps=steps, target_update=average, best=best, **options)


@contextlib.contextmanager
def _interrupts_let_through() -> Iterator[None]:
    """Raises a KeyboardInterrupt again that ``with params.to_module(network)`` of a loss made a tensordict error."""
    try:
        yield
    except Exception as error:
        cause: BaseException | None = error  # after two signals the interrupt lies deeper in the chain
        while cause is not None and not isinstance(cause, KeyboardInterrupt):
            cause = cause.__context__
        if cause is not None:
            raise cause from None
        raise


class AdaptiveClipping(nn.Module):
    """Clips gradients to five times the root mean square of earlier gradient lengths.

    Once gradients are short, so is the second moment that AdamW divides by. A gradient several times as long then moves
    every parameter by several learning rates. The next gradient is longer still, and within twenty updates the loss is
    back at its initial value. Such jumps are known from large models (Wortsman et al. 2023, which limits the update by
    the same comparison, tensor by tensor). Here the length of the whole gradient is compared, so that a training
    without outliers is unchanged.

    Call it between ``backward`` and the optimiser's step. Checkpoints hold its state dict, so that a resumed training
    is the same.

    Args:
        parameters (iterable): the trained parameters.
        decay (float): decay of the mean squared length: the optimiser's second beta.
    """

    mean_square: Tensor
    seen: Tensor

    def __init__(self, parameters: Iterable[nn.Parameter], decay: float):
        super().__init__()
        self._trained, self.decay = tuple(parameters), decay
        self.register_buffer("mean_square", torch.zeros([], dtype=torch.float64))
        self.register_buffer("seen", torch.zeros([], dtype=torch.float64))

    @torch.no_grad()
    def forward(self) -> Tensor:
        """Scales the gradient in place; returns the factor ``[]``, 1 except for outliers after 100 updates."""
        gradients = [each.grad for each in self._trained if each.grad is not None]
        length = torch.nn.utils.get_total_norm(gradients)
        typical = (self.mean_square / (1 - self.decay**self.seen)).sqrt()
        factor = (TIMES * typical / length).clamp(max=1.0).nan_to_num(1.0)  # if zero or not finite
        factor = torch.where((self.seen < SETTLED) | (typical == 0), 1.0, factor).to(length)
        if factor.is_cuda or factor < 1:  # reading it on a GPU would synchronise
            torch._foreach_mul_(gradients, factor)
        square = (factor * length).square().nan_to_num(0.0, posinf=0.0)
        self.mean_square.lerp_(square.to(self.mean_square), 1 - self.decay)
        self.seen += 1
        return factor
