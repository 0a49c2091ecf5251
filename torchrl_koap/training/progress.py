# This source code is licensed under the MIT license found in the LICENSE file.
"""The progress bar of a training phase."""

from __future__ import annotations

from collections.abc import Callable

from tqdm import tqdm


def progress_bar(total: int, description: str) -> tqdm:
    """A bar that counts updates."""
    return tqdm(total=total, desc=description, unit="it", smoothing=0.05, mininterval=0.5)


def show_progress(bar: tqdm) -> Callable[[int, dict[str, float]], None]:
    """What :func:`~torchrl_koap.training.loop.train` calls after every update: moves the bar, shows the losses."""

    def update(step: int, values: dict[str, float]) -> None:
        bar.update(step - bar.n)
        if values and step % 50 == 0:
            bar.set_postfix(
                {key.removeprefix("loss_"): f"{value:.4f}" for key, value in values.items() if "loss" in key}
            )

    return update
