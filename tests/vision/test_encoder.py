# This source code is licensed under the MIT license found in the LICENSE file.
"""Frozen encoders: what is kept, what is refused, and what a cache is good for."""

from __future__ import annotations

import importlib.util

import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.vision import (
    CacheError,
    EmbeddingCache,
    FrozenImageEncoder,
    Projection,
    WeightsError,
    backbones,
    load_backbone,
)
from torchrl_koap.vision.backbones import Backbone
from torchrl_koap.vision.pooling import average, grid, spatial_softmax
from torchrl_koap.vision.projections import load_encoder, save_encoder
from torchrl_koap.vision.resnet import ResNet

HAS_WEIGHTS = all(importlib.util.find_spec(name) for name in backbones._PACKAGES)
needs_weights = pytest.mark.skipif(not HAS_WEIGHTS, reason="the weights of the extra 'vision' are not installed")


@pytest.fixture
def weights(tmp_path):
    """A file as torchvision's: a ResNet-18 with random weights."""
    torch.manual_seed(0)
    path = tmp_path / "resnet18.pth"
    torch.save(ResNet("resnet18").state_dict(), path)
    return path


def frames(count=3, size=32, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (count, size, size, 3), dtype=torch.uint8, generator=generator)


def encoder(weights, **options):
    return FrozenImageEncoder(load_backbone(weights), size=32, **options)


def test_a_resnet_from_a_file_embeds_and_stays_as_it_is(weights):
    embed = encoder(weights, pooling="average").train()
    data = embed(TensorDict({"pixels": frames()[None]}, [1]))
    assert data["embedding"].shape == (1, 3, 128) and not data["embedding"].requires_grad
    assert not embed.backbone.training and not any(p.requires_grad for p in embed.parameters())
    pictures = frames().permute(0, 3, 1, 2).float() / 255
    mean, std = (torch.tensor(values)[:, None, None] for values in (backbones.MEAN, backbones.STD))
    wanted = load_backbone(weights).stages((pictures - mean) / std).mean((-2, -1))
    torch.testing.assert_close(data["embedding"][0], wanted)
    torch.testing.assert_close(embed.embed(frames()[1]), wanted[1], rtol=1e-4, atol=1e-5)  # alone as in a batch


def test_places_are_lost_by_the_average_and_kept_by_the_others():
    left, right = torch.zeros(1, 1, 12, 12), torch.zeros(1, 1, 12, 12)
    left[..., 5, 2] = right[..., 5, 9] = 50.0
    assert torch.equal(average(left), average(right))
    assert spatial_softmax(left)[0, 0] < -0.5 and spatial_softmax(right)[0, 0] > 0.5
    torch.testing.assert_close(spatial_softmax(left)[0, 1], spatial_softmax(right)[0, 1])
    assert grid(left)[0].argmax() == 2 * 6 + 1 and grid(right)[0].argmax() == 2 * 6 + 4


def test_a_projection_keeps_what_varies_most_and_survives_its_file(tmp_path, weights):
    features = torch.randn(300, 8, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [9.0, 5, 1, 1, 1, 1, 1, 1]
    )
    projection = Projection.fit(features, 2)
    assert set(projection.components.abs().argmax(0).tolist()) == {0, 1}
    wide = Projection.fit(features[:6], 2)  # fewer frames than features: the same subspace idea, another product
    assert wide(features[:6]).std(0)[0].item() == pytest.approx(1.0, rel=1e-3)
    with pytest.raises(ValueError, match="fitted on 8 features, got 5"):
        projection(torch.zeros(2, 5))
    with pytest.raises(ValueError, match="8 components need more"):
        Projection.fit(features, 8)
    embed = encoder(weights, pooling="average", projection=Projection.fit(torch.randn(300, 128), 4))
    file = save_encoder(embed, tmp_path / "own.safetensors", stride=8, fitted_on="noise")
    again = load_encoder(file, weights)
    torch.testing.assert_close(again.embed(frames()), embed.embed(frames()), rtol=0, atol=2e-2)


def test_frames_of_another_size_or_dtype_are_refused(weights):
    embed = encoder(weights)
    with pytest.raises(ValueError, match=r"\[\*B, 32, 32, 3\], got shape \[1, 48, 48, 3\]"):
        embed.embed(frames(1, 48))
    with pytest.raises(ValueError, match="uint8 in 0 to 255, got torch.float32"):
        embed.embed(frames().float())


def test_weights_that_are_missing_damaged_or_of_another_network(tmp_path, weights, monkeypatch):
    with pytest.raises(WeightsError, match="there is no file"):
        load_backbone(tmp_path / "none.pth")
    (tmp_path / "text.pth").write_text("no weights")
    with pytest.raises(WeightsError, match="is no file of weights"):
        load_backbone(tmp_path / "text.pth")
    torch.save({"head.weight": torch.zeros(2)}, tmp_path / "other.pth")
    with pytest.raises(WeightsError, match="another network.*'head.weight'"):
        load_backbone(tmp_path / "other.pth")
    state = torch.load(weights, weights_only=True) | {"layer4.1.bn2.weight": torch.zeros(3)}
    torch.save(state, tmp_path / "cut.pth")
    with pytest.raises(WeightsError, match="another network"):
        load_backbone(tmp_path / "cut.pth")
    monkeypatch.setattr(backbones, "_PACKAGES", ("no_such_package_of_weights",))
    with pytest.raises(WeightsError, match=r"torchrl_koap\[vision\]"):
        load_backbone()


def test_a_projection_of_other_weights_is_refused(tmp_path, weights):
    embed = encoder(weights, pooling="average", projection=Projection.fit(torch.randn(300, 128), 4))
    file = save_encoder(embed, tmp_path / "own.safetensors", stride=8, fitted_on="noise")
    torch.manual_seed(1)
    torch.save(ResNet("resnet18").state_dict(), tmp_path / "second.pth")
    with pytest.raises(WeightsError, match="fitted behind the weights"):
        load_encoder(file, tmp_path / "second.pth")


def test_a_cache_answers_instead_of_the_network_and_belongs_to_its_weights(tmp_path, weights, monkeypatch):
    embed = encoder(weights, cache=tmp_path / "cache")
    first = embed.features(frames())
    monkeypatch.setattr(Backbone, "forward", lambda *_: pytest.fail("the network was asked again"))
    assert torch.equal(embed.features(frames()), first)
    monkeypatch.undo()
    with pytest.raises(CacheError, match="made with pooling spatial_softmax, wanted grid"):
        encoder(weights, pooling="grid", cache=tmp_path / "cache")
    with pytest.raises(CacheError, match="made with weights"):
        EmbeddingCache(tmp_path / "cache", embed.identity | {"weights": "ffff"})
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter.txt").write_text("mine")
    with pytest.raises(CacheError, match="is not empty and no cache"):
        EmbeddingCache(tmp_path / "full", embed.identity)


@needs_weights
def test_the_package_s_projection_fits_the_embedded_weights():
    embed = load_encoder()
    picture = torch.zeros(1, 96, 96, 3, dtype=torch.uint8)
    assert embed.embed(picture).shape == (1, 96) and embed.embed(picture).isfinite().all()
    assert embed.identity["network"] == "efficientnet_lite0" and embed.identity["places"] == "12x12"
