"""The architecture, and that what inference runs is what was trained."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from koop_service.encoding import image_codec, inference
from koop_service.encoding.architecture import FLOW, PAPER, Architecture
from koop_service.encoding.autoencoder import channels_first, initialised
from koop_service.encoding.folding import fold
from koop_service.encoding.image_codec import ImageCodec
from koop_service.encoding.weights import ModelCard

CARD = ModelCard(system="test", renderer="none", dt=0.05)

# A field of four channels, as small as the flow's architecture takes.
FIELD = (4, 64, 128)
FIELD_CARD = ModelCard(
    "test", "none", 0.15, image_shape=FIELD, value_range=(-20.0, 20.0), architecture=FLOW
)


def lived_in(seed: int, shape: tuple[int, ...] = (64, 64), architecture: Architecture = PAPER):
    """A model whose normalisations have seen data: every scale, also a negative one."""
    model = initialised(8, seed, shape, architecture).eval()
    generator = torch.Generator().manual_seed(seed)
    for module in model.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.weight.data.normal_(0, 1, generator=generator)
            module.bias.data.normal_(0, 0.3, generator=generator)
            module.running_mean.normal_(0, 0.5, generator=generator)
            module.running_var.uniform_(0.5, 2.0, generator=generator)
    return model


def pictures(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (count, 64, 64)).astype(np.uint8)


def test_the_papers_parameter_count():
    assert sum(p.numel() for p in initialised(8, 0).parameters()) == 117_963


def test_encoder_and_decoder_split_the_count_as_the_mathematics_page_says():
    model = initialised(8, 0)
    assert sum(p.numel() for p in model.encoder.parameters()) == 81_432
    assert sum(p.numel() for p in model.decoder.parameters()) == 36_531


def test_a_seed_names_the_parameters():
    one, same, other = (initialised(8, seed).state_dict() for seed in (1, 1, 2))
    assert all(torch.equal(one[name], same[name]) for name in one)
    assert not all(torch.equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize(
    ("shape", "architecture"), [((64, 64), PAPER), (FIELD, FLOW), ((2, 32, 96), Architecture((8,)))]
)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_folding_keeps_the_function(seed, shape, architecture):
    model = lived_in(seed, shape, architecture)
    encoder, decoder = fold(model)
    images = torch.rand(5, *channels_first(shape))
    assert model.decode(model.encode(images)).shape == images.shape
    codes = model.encode(images)
    torch.testing.assert_close(encoder(images).flatten(1), codes, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(
        decoder(codes[:, :, None, None]), model.decode(codes), rtol=1e-4, atol=1e-4
    )
    assert not any(isinstance(m, nn.BatchNorm2d) for m in (*encoder.modules(), *decoder.modules()))


@pytest.mark.parametrize(
    ("shape", "architecture"), [((64, 64), PAPER), (FIELD, FLOW), ((2, 32, 96), Architecture((8,)))]
)
def test_a_processor_computes_what_torch_does(shape, architecture):
    model = lived_in(6, shape, architecture)
    card = replace(CARD, image_shape=shape, architecture=architecture, value_range=(-1e9, 1e9))
    codec = ImageCodec(model, card)
    assert codec.computed_by.startswith("onnxruntime ")
    images = np.random.default_rng(0).random((3, *shape), np.float32)
    with torch.inference_mode():
        codes = model.encode(torch.tensor(images).reshape(3, *channels_first(shape)))
        decoded = model.decode(codes).reshape(images.shape)
    np.testing.assert_allclose(codec.encode(images), codes, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(codec.decode(codes.numpy()), decoded, rtol=1e-4, atol=1e-4)


def test_a_layer_that_no_folded_network_has_is_told():
    with pytest.raises(TypeError, match="no folded network has a layer Sigmoid"):
        inference.prepare(nn.Sequential(nn.Sigmoid()), (1, 64, 64), torch.device("cpu"))


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_torch_and_onnx_runtime_compute_the_same(dtype):
    encoder, _ = fold(lived_in(7))
    images = pictures(3)[:, None] if dtype == np.uint8 else np.float32(pictures(3)[:, None] / 255)
    torchs = inference._by_torch(encoder, torch.device("cpu"))(images)
    others = inference._by_onnxruntime(encoder, (1, 64, 64))(images)
    np.testing.assert_allclose(torchs, others, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("device", "differs", "sizes"),
    [
        ("cpu", lambda _: 0.0, [1, 16, 1]),
        ("cpu", lambda size: size == 1, [2, 16, 2]),
        ("cuda", lambda size: size, [128, 128]),
    ],
)
def test_batches_of_a_size_that_rounds_differently_are_padded(monkeypatch, device, differs, sizes):
    got = []

    def network(inputs):
        """Of means, which a batch of another size may have from another kernel."""
        got.append(len(inputs))
        means = inputs.mean((2, 3)) * (1 + 1e-3 * differs(len(inputs)))
        return np.repeat(means, 8, 1).astype(np.float32)

    monkeypatch.setattr(image_codec, "prepare", lambda *_: network)
    codec, images = ImageCodec(lived_in(3), CARD, device), pictures(17)
    got.clear()
    assert np.array_equal(codec.encode(images[16:]), codec.encode(images)[16:])
    assert got == sizes


def test_a_codes_bits_do_not_depend_on_the_batch_it_rode_in():
    codec = ImageCodec(lived_in(3), CARD)
    images = pictures(130)
    together = codec.encode(images)
    for size in (1, 2, 3, 31, 64, 65):
        parts = [codec.encode(images[i : i + size]) for i in range(0, 130, size)]
        assert np.array_equal(np.concatenate(parts), together), f"batches of {size}"
        hurried = [codec.encode(images[i : i + size], hurried=True) for i in range(0, 130, size)]
        assert np.array_equal(np.concatenate(hurried), together), f"halved batches of {size}"
    order = np.random.default_rng(1).permutation(130)
    assert np.array_equal(codec.encode(images[order]), together[order])


def test_of_no_picture_there_is_no_code_and_of_no_code_no_picture():
    codec = ImageCodec(lived_in(4), CARD)
    assert codec.encode(pictures(0)).shape == (0, 8)
    assert codec.decode(np.zeros((0, 8))).shape == (0, 64, 64)


def test_pixel_types_mean_the_same_picture():
    codec = ImageCodec(lived_in(4), CARD)
    images = pictures(3)
    as_float = codec.encode((images / 255).astype(np.float32))
    np.testing.assert_allclose(as_float, codec.encode(images), atol=1e-5)


def test_decoded_pictures_stay_in_range():
    codec = ImageCodec(lived_in(5), CARD)
    codes = 10 * np.random.default_rng(0).normal(size=(7, 8))
    floats, bytes_ = codec.decode(codes), codec.decode(codes, np.uint8)
    assert floats.shape == bytes_.shape == (7, 64, 64)
    assert floats.min() >= 0
    assert floats.max() <= 1
    np.testing.assert_allclose(bytes_ / 255, floats, atol=0.5 / 255 + 1e-6)


def fields(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, *FIELD)).astype(np.float16)


@pytest.mark.parametrize(("code_size", "count"), [(8, 327_620), (32, 340_748)])
def test_the_flows_parameter_count(code_size, count):
    model = initialised(code_size, 0, (4, 128, 256), FLOW)
    assert sum(p.numel() for p in model.parameters()) == count


def test_sides_that_cannot_be_halved_are_told():
    with pytest.raises(ValueError, match=r"100 x 256 cannot be halved 6 times; .*multiples of 64"):
        initialised(8, 0, (4, 100, 256), FLOW)


@pytest.mark.parametrize("wrong", [{"channels": ()}, {"channels": (0,)}, {"overlap": 1}])
def test_an_architecture_that_cannot_be_built(wrong):
    with pytest.raises(ValueError, match="cannot be built; expected channels"):
        Architecture(**wrong)


def test_overlap_lets_neighbouring_pixels_share_what_they_are_drawn_from():
    """A change of one innermost feature is seen beyond the patch that it is alone to draw."""
    for architecture, alone in (
        (Architecture((4,), overlap=0), True),
        (Architecture((4,), 2), False),
    ):
        model = initialised(4, 0, (8, 8), architecture).eval()
        outer, features = model.decoder[-1], torch.zeros(1, 4, 4, 4)
        changed = features.clone()
        changed[..., 1, 1] = 1.0
        difference = (outer(changed) - outer(features)).detach()[0, 0] != 0
        difference[2:4, 2:4] = False
        assert bool(difference.any()) != alone


def test_a_fields_code_does_not_depend_on_the_batch_it_rode_in():
    codec = ImageCodec(lived_in(3, FIELD, FLOW), FIELD_CARD)
    together = codec.encode(fields(9))
    for size in (1, 2, 4):
        parts = [codec.encode(fields(9)[i : i + size]) for i in range(0, 9, size)]
        assert np.array_equal(np.concatenate(parts), together), f"batches of {size}"


def test_fields_are_encoded_as_they_are():
    model = lived_in(4, FIELD, FLOW)
    codec = ImageCodec(model, FIELD_CARD)
    expected = model.encode(torch.from_numpy(fields(2)).float()).detach().numpy()
    np.testing.assert_allclose(codec.encode(fields(2)), expected, rtol=1e-3, atol=1e-4)
    assert np.array_equal(codec.encode(fields(2)), codec.encode(fields(2).astype(np.float32)))


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_decoded_fields_keep_their_type_and_stay_in_their_range(dtype):
    codec = ImageCodec(lived_in(5, FIELD, FLOW), FIELD_CARD)
    shown = codec.decode(1e6 * np.random.default_rng(0).normal(size=(3, 8)), dtype)
    assert (shown.shape, shown.dtype) == ((3, *FIELD), dtype)
    assert (shown.min(), shown.max()) == (-20.0, 20.0)
