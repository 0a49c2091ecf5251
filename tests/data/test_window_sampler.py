# This source code is licensed under the MIT license found in the LICENSE file.
"""Windows are equally likely, hold the promised labels, and a draw is the generator's alone."""

import pytest
import torch
from counted_windows import demonstrations, seen

from torchrl_koap.data import LabelBudget, WindowSampler, make_window_buffer


def make(share):
    data, _ = LabelBudget(count=1, seed=1).apply(demonstrations())
    return make_window_buffer(data, 16, 6, labelled_share=share)


def test_windows_are_equally_likely():
    torch.manual_seed(0)
    data = demonstrations((16, 116))
    buffer = make_window_buffer(data, 16, 20_400, select=["observation"])
    counts = torch.zeros(102)
    for trajectory, steps in seen(buffer.sample()):
        counts[0 if trajectory == 0 else 1 + steps[0]] += 1
    # 102 windows, 200 expected each: chi-squared with 101 degrees of freedom is below 150 in 99.9 %
    assert ((counts - 200) ** 2 / 200).sum() < 150


@pytest.mark.parametrize(
    ("share", "size", "number"), [(0.25, 16, 4), (0.5, 5, 3), (0.1, 7, 1), (1.0, 8, 8), (0.9, 4, 4)]
)
def test_every_batch_holds_its_share(share, size, number):
    data, _ = LabelBudget(count=1, seed=2).apply(demonstrations())  # the longest: 25 windows of 49
    buffer = make_window_buffer(data, 16, size, labelled_share=share)
    for _ in range(12):
        batch = buffer.sample()
        inner = batch["has_action"][:, 1:15].any(1).squeeze(-1)
        assert inner.tolist() == [True] * number + [False] * (size - number)


def test_fully_labelled_data_have_no_other_windows():
    sampler = WindowSampler(torch.ones(7, dtype=torch.bool), labelled_share=0.25)
    torch.manual_seed(0)
    assert set(sampler.sample(None, 400)[0][100:].tolist()) == set(range(7))


def test_wrong_shares():
    nothing = torch.zeros(49, dtype=torch.bool)
    with pytest.raises(ValueError, match="none of the 49 windows has a label"):
        WindowSampler(nothing, labelled_share=0.25)
    for wrong in (0, -0.1, 1.1):
        with pytest.raises(ValueError, match="labelled_share must be in"):
            WindowSampler(~nothing, labelled_share=wrong)


@pytest.mark.parametrize("share", [None, 0.5])
def test_a_run_goes_on_where_it_stopped(share):
    """The random state is all of it: the sampler has none of its own."""
    buffer, resumed = make(share), make(share)
    buffer.sample()
    state = torch.get_rng_state()
    expected = [seen(buffer.sample()) for _ in range(9)]
    resumed.sample()
    torch.set_rng_state(state)
    assert [seen(resumed.sample()) for _ in range(9)] == expected


@pytest.mark.parametrize("own", [True, False])
def test_sampling_uses_an_own_generator_or_the_global_one(own):
    draws = []
    for number in range(2):
        torch.manual_seed(number if own else 0)
        buffer = make(0.5)
        if own:
            buffer.set_rng(torch.Generator().manual_seed(0))
        draws.append([seen(buffer.sample()) for _ in range(2)])
    assert draws[0] == draws[1] and draws[0][0] != draws[0][1]
