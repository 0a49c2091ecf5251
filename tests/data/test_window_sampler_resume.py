# This source code is licensed under the MIT license found in the LICENSE file.
"""A buffer of windows goes on exactly where it stopped, and draws by the generator it is told."""

from __future__ import annotations

import pytest
import torch
from counted_windows import demonstrations, seen
from torchrl.checkpoint import Checkpoint, GlobalRNGState

from torchrl_koap.data import LabelBudget, make_window_buffer


def make(replacement, share, seed=5):
    data, _ = LabelBudget(1, "trajectory", seed=1).apply(demonstrations())
    return make_window_buffer(data, 16, 6, labelled_share=share, replacement=replacement)


@pytest.mark.parametrize("share", [None, 0.5])
@pytest.mark.parametrize("replacement", [True, False])
@pytest.mark.parametrize("how", ["dumps", "state_dict", "checkpoint"])
def test_exact_resume(how, replacement, share, tmp_path):
    torch.manual_seed(3)
    buffer = make(replacement, share)
    for _ in range(4):
        buffer.sample()
    rng = GlobalRNGState()
    if how == "checkpoint":
        checkpoint = Checkpoint()
        checkpoint.register("buffer", buffer)
        checkpoint.register("rng", rng)
        checkpoint.save(tmp_path / "state")
    elif how == "dumps":
        buffer.dumps(tmp_path / "state")
        state = rng.state_dict()
    else:
        state, saved = rng.state_dict(), buffer.state_dict()
    expected = [seen(buffer.sample()) for _ in range(9)]

    torch.manual_seed(999)
    resumed = make(replacement, share)
    resumed.sample()
    rng = GlobalRNGState()
    if how == "checkpoint":
        checkpoint = Checkpoint()
        checkpoint.register("buffer", resumed)
        checkpoint.register("rng", rng)
        checkpoint.load(tmp_path / "state")
    elif how == "dumps":
        resumed.loads(tmp_path / "state")
        rng.load_state_dict(state)
    else:
        resumed.load_state_dict(saved)
        rng.load_state_dict(state)
    assert [seen(resumed.sample()) for _ in range(9)] == expected


def test_other_options_are_refused(tmp_path):
    make(False, 0.5).dumps(tmp_path / "state")
    with pytest.raises(ValueError, match=r"labelled_share 0\.5 \(here -1\)"):
        make(False, None).loads(tmp_path / "state")


def test_an_own_generator():
    draws = []
    for _ in range(2):
        torch.manual_seed(len(draws))
        buffer = make(True, 0.5)
        buffer.set_rng(torch.Generator().manual_seed(0))
        draws.append(seen(buffer.sample()))
    assert draws[0] == draws[1]


def test_sampling_uses_the_global_generator():
    buffer = make(True, 0.5)
    torch.manual_seed(0)
    first = seen(buffer.sample())
    torch.manual_seed(0)
    assert seen(buffer.sample()) == first
    assert seen(buffer.sample()) != first
