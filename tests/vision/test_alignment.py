# This source code is licensed under the MIT license found in the LICENSE file.
"""Alignment of embodiments: partners and map are found without labels, and what cannot be aligned is refused."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_koap.vision.alignment import fit_alignment

COLUMNS = 12
STARTS = torch.tensor([[0.0, 1.0, 0.2], [-1.2, 0.0, 0.1], [0.1, -1.1, 0.3]])


def path(start, frames, generator):
    """A way from near a start to the middle, down and up again ``[T, 3]``."""
    share = torch.linspace(0, 1, frames)[:, None]
    near = STARTS[start] + 0.05 * torch.randn(3, generator=generator)
    dip = torch.tensor([0.0, 0.0, -0.8]) * torch.sin(math.pi * share)
    return near * (1 - share) ** 2 + dip


def embedding(seed):
    """A camera of a body of its own: another linear map and another offset, both nearly the same for all bodies."""
    generator = torch.Generator().manual_seed(9)
    shared = torch.randn(3, COLUMNS, generator=generator)
    own = torch.Generator().manual_seed(seed)
    weight, offset = (torch.randn(*size, generator=own) for size in ((3, COLUMNS), (COLUMNS,)))
    return lambda places: places @ (shared + 0.3 * weight) + 2 * offset


@pytest.fixture
def bodies():
    """Places and embeddings of a slow robot, five times, and of a quick hand, thirty times."""
    generator = torch.Generator().manual_seed(0)
    robot = [path(number % 3, 50 + 2 * number, generator) for number in range(6)]
    hand = [path(number % 3, 25 + number % 7, generator) for number in range(30)]
    look, other = embedding(1), embedding(2)
    return robot, hand, [look(part) for part in robot], [other(part) for part in hand], look


def distance(parts, wanted):
    """Root mean square distance of frames."""
    return (torch.cat(parts) - torch.cat(wanted)).square().sum(-1).mean().sqrt()


def test_the_hand_is_seen_as_the_robot_would_be_at_its_place(bodies):
    _, hand, seen, other, look = bodies
    wanted = [look(part) for part in hand]
    alignment = fit_alignment(other, seen)
    moved = [alignment(part) for part in other]
    assert distance(moved, wanted) < 0.05 * distance(other, wanted)
    shift = torch.cat(seen).mean(0) - torch.cat(other).mean(0)
    assert distance(moved, wanted) < 0.3 * distance([part + shift for part in other], wanted)


def test_partners_begin_at_the_same_place_and_are_taken_equally_often(bodies):
    _, hand, seen, other, _ = bodies
    partners = fit_alignment(other, seen, free_rounds=0).partners
    assert [partner % 3 for partner in partners] == [number % 3 for number in range(len(hand))]
    assert all(partners.count(number) == 5 for number in range(6))


def test_starts_need_not_be_shown_equally_often(bodies):
    _, _, seen, other, _ = bodies
    uneven = [number for number in range(30) if number % 3 or number < 9]  # the first start is rare
    parts = [other[number] for number in uneven]
    partners = fit_alignment(parts, seen).partners
    assert [partner % 3 for partner in partners] == [number % 3 for number in uneven]
    even = fit_alignment(parts, seen, free_rounds=0).partners
    assert [partner % 3 for partner in even] != [number % 3 for number in uneven]


def test_dtype_and_batch_are_those_of_what_is_moved(bodies):
    _, _, seen, other, _ = bodies
    alignment = fit_alignment(other, seen)
    moved = alignment(torch.stack([other[0][:4], other[1][:4]]))
    assert moved.shape == (2, 4, COLUMNS) and moved.dtype == torch.float32
    torch.testing.assert_close(moved[1], alignment(other[1])[:4])
    assert alignment(other[0].double()).dtype == torch.float64


def test_constant_columns_do_no_harm(bodies):
    _, _, seen, other, _ = bodies
    constant = [torch.cat([part, torch.ones(len(part), 2)], 1) for part in other]
    plain, wider = fit_alignment(other, seen), [torch.cat([part, torch.zeros(len(part), 2)], 1) for part in seen]
    moved = fit_alignment(constant, wider)(constant[0])
    torch.testing.assert_close(moved[:, COLUMNS:], torch.zeros(len(moved), 2))
    torch.testing.assert_close(moved[:, :COLUMNS], plain(other[0]), atol=0.05, rtol=0)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda other, seen: ([], seen), "source has none"),
        (lambda other, seen: (other, []), "target has none"),
        (lambda other, seen: ([other[0], other[1][:1]], seen), "source: demonstration 1 has fewer than two frames"),
        (lambda other, seen: (other, [seen[0] * math.nan]), "target: demonstration 0 has values that are not finite"),
        (lambda other, seen: ([other[0], other[1][:, :3]], seen), "source: the demonstrations have embeddings of diff"),
        (lambda other, seen: ([part[:, :3] for part in other], seen), "embeddings of 3 and 12 columns"),
    ],
)
def test_what_cannot_be_aligned_is_refused(bodies, spoil, said):
    _, _, seen, other, _ = bodies
    with pytest.raises(ValueError, match=said):
        fit_alignment(*spoil(other, seen))


@pytest.mark.parametrize(
    ("option", "value"),
    [("phases", 1), ("rounds", 0), ("free_rounds", -1), ("ridge", -0.1), ("ridge", math.nan), ("ridge", math.inf)],
)
def test_options_out_of_range_are_refused_by_name(bodies, option, value):
    _, _, seen, other, _ = bodies
    with pytest.raises(ValueError, match=f"{option} must be at least"):
        fit_alignment(other, seen, **{option: value})
