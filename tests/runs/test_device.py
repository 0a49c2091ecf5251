# This source code is licensed under the MIT license found in the LICENSE file.
"""Matrix products in bfloat16 only where the machine has units for them, unless asked for by name."""

import warnings

import pytest
import torch

from torchrl_koap.runs.device import find_precision, has_bfloat16_units, set_up_torch


@pytest.fixture(params=["amx_bf16", "avx512_bf16", None])
def units(request, monkeypatch):
    monkeypatch.setattr(
        torch.cpu, "get_capabilities", lambda: {"avx2": True} | {name: True for name in [request.param] if name}
    )
    return request.param


def test_auto_is_what_the_processor_has_units_for(units):
    assert has_bfloat16_units() == (units is not None)
    assert find_precision("auto") == ("float32" if units is None else "bfloat16")


def test_float32_by_name_is_obeyed(units):
    assert find_precision("float32") == "float32"


def test_bfloat16_by_name_is_obeyed_and_warns_where_it_is_emulated(units):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert find_precision("bfloat16") == "bfloat16"
    assert len(caught) == (units is None)
    assert units is not None or "'auto'" in str(caught[0].message)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_missing_gpu_is_said():
    with pytest.raises(ValueError, match="'cuda:1' was asked for, but torch finds no CUDA here"):
        set_up_torch(1, "cuda:1")


def test_no_number_of_threads_leaves_torch_alone():
    before = torch.get_num_threads()
    set_up_torch(None, "cpu")
    assert torch.get_num_threads() == before
