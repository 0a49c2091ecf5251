# This source code is licensed under the MIT license found in the LICENSE file.
"""Simulates a GPU: its tensors report ``cuda:0``, compute on the CPU, and do not mix with CPU tensors."""

from contextlib import contextmanager

import torch
from torch import nn
from torch.nn.parameter import is_lazy
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves, tree_map

GPU = torch.device("cuda:0")
FACTS = {"device": GPU, "is_cuda": True, "is_cpu": False}
MIXING = ("to", "cpu", "copy_", "__getitem__", "__setitem__")  # may take tensors of two devices


class GPUTensor(torch.Tensor):
    @staticmethod
    def __new__(cls, inner):
        facts = {"dtype": inner.dtype, "strides": inner.stride(), "storage_offset": inner.storage_offset()}
        return torch.Tensor._make_wrapper_subclass(cls, inner.shape, device=GPU, **facts)

    def __init__(self, inner):
        self.inner = inner

    @classmethod
    def __torch_function__(cls, function, types, args=(), kwargs=None):
        return _call(function, args, kwargs or {})

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None):
        raise RuntimeError(f"{function} needs a real GPU")


def _inner(value):
    return value.inner if isinstance(value, GPUTensor) else value


def _names_device(value):
    return isinstance(value, torch.device) or (isinstance(value, str) and value.split(":")[0] in ("cpu", "cuda"))


def _call(function, args, kwargs):
    name, leaves = getattr(function, "__name__", ""), tree_leaves((args, kwargs))
    own = [leaf for leaf in leaves if isinstance(leaf, GPUTensor)]
    devices = [leaf for leaf in leaves if _names_device(leaf)]
    if name in ("_parse_to", "device") or not (own or devices):
        return function(*args, **kwargs)
    tensors = [leaf for leaf in leaves if isinstance(leaf, torch.Tensor) and not isinstance(leaf, GPUTensor)]
    others = [tensor for tensor in tensors if tensor.ndim]
    fact = getattr(getattr(function, "__self__", None), "__name__", "")
    if own and name == "__get__" and fact in FACTS:
        return FACTS[fact]
    if own and name in ("numpy", "__array__"):
        raise TypeError("a CUDA tensor cannot become an array")
    if own and others and name not in MIXING and "index" not in name:
        raise RuntimeError(f"{name}: tensors on cuda:0 and cpu")
    if name == "__getitem__" and own and not isinstance(args[0], GPUTensor):
        raise RuntimeError("a tensor on cpu is indexed by one on cuda:0")
    if name == "__setitem__" and any(isinstance(args[0], GPUTensor) != isinstance(part, GPUTensor) for part in others):
        raise RuntimeError("__setitem__: tensors on cuda:0 and cpu")
    to_gpu = any("cuda" in str(device) for device in devices) if devices else bool(own) and name != "cpu"
    with torch._C.DisableTorchFunction():
        args, kwargs = tree_map(lambda leaf: "cpu" if _names_device(leaf) else _inner(leaf), (args, kwargs))
        result = function(*args, **kwargs)
    if isinstance(result, torch.Size):
        return result
    return tree_map(lambda leaf: GPUTensor(leaf) if to_gpu and isinstance(leaf, torch.Tensor) else leaf, result)


class _Mode(TorchFunctionMode):
    def __torch_function__(self, function, types, args=(), kwargs=None):
        return _call(function, args, kwargs or {})


def _module_to(module, device):
    """Moves a module's tensors; parameters become tensors that need no gradient."""
    for part in module.modules():
        for table in (part._parameters, part._buffers):
            whole = {name: value for name, value in table.items() if value is not None and not is_lazy(value)}
            table.update({name: value.detach().to(device) for name, value in whole.items()})
    return module


@contextmanager
def pretended_gpu(monkeypatch):
    """Lets tensors and modules be moved to ``"cuda:0"`` inside the block, without gradients."""
    with monkeypatch.context() as patch, torch.no_grad(), _Mode():
        patch.setattr(nn.Module, "to", _module_to)
        patch.setattr(nn.Module, "cpu", lambda module: _module_to(module, "cpu"))
        for name, value in (("is_available", True), ("device_count", 1), ("synchronize", None)):
            patch.setattr(torch.cuda, name, lambda *args, value=value, **kwargs: value)
        yield
