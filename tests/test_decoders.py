"""Decoders: sizes as published, encodings open to masks, harmonics against SciPy."""

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

import gridreg
from backbones import decoders
from backbones.decoders import MLPDecoder, make_decoder, spherical_harmonics
from gridreg import ops


@pytest.mark.parametrize(
    ("name", "columns"),
    [
        # TensoRF's MLPRender_Fea with 2 + 2 octaves, MLPRender_PE with 6 + 2, and Few TensoRF's with 6 / 6 / 2.
        ("mlp_fea", 27 * 5 + 3 * 5),
        ("mlp_pe", 27 + 3 * 5 + 3 * 13),
        ("mlp", 27 * 5 + 3 * 13 + 3 * 13),
    ],
)
def test_the_first_layer_is_as_wide_as_published(name, columns):
    features, decoder = make_decoder(name)
    assert features == 27
    assert decoder.layers[0].in_features == columns
    assert [layer.out_features for layer in decoder.layers] == [128, 128, 3]


def test_a_decoder_equals_the_mlp_written_out():
    decoder = MLPDecoder(
        4, feature_octaves=1, direction_octaves=2, position_octaves=3, width=8, precision="float32"
    )
    f, d, x = torch.randn(9, 4), normalize(torch.randn(9, 3), dim=-1), torch.rand(9, 3) * 2 - 1

    def encode(value, octaves):
        parts = [value]
        for k in range(octaves):
            parts += [torch.sin(2**k * value), torch.cos(2**k * value)]
        return torch.cat(parts, dim=-1)

    hidden = torch.cat([encode(f, 1), encode(d, 2), encode(x, 3)], dim=-1)
    for layer in decoder.layers[:2]:
        hidden = torch.relu(hidden @ layer.weight.T + layer.bias)
    expected = torch.sigmoid(hidden @ decoder.layers[2].weight.T + decoder.layers[2].bias)
    torch.testing.assert_close(decoder(f, d, x), expected)


def test_encoding_sites_cover_the_columns_and_know_their_octaves():
    decoder = MLPDecoder(4, feature_octaves=1, direction_octaves=2, position_octaves=3, width=8)
    sites = decoder.sites("decoder")
    assert sorted(sites) == ["encoding.direction", "encoding.features", "encoding.position"]
    covered = []
    for site, width, octaves in (("features", 4, 1), ("direction", 3, 2), ("position", 3, 3)):
        (selector,) = sites[f"encoding.{site}"].mask
        expected = [-1] * width + [k for k in range(octaves) for _ in range(2 * width)]
        assert list(selector.octaves) == expected
        covered.append(selector.channels)
    assert "encoding.position" not in MLPDecoder(4, position_octaves=None).sites("decoder")


@pytest.mark.parametrize("step", [0, 1, 3, 6, 9, 10])
@pytest.mark.parametrize("precision", ["float32", "auto"])
def test_octaves_that_masks_have_closed_are_left_out(step, precision, monkeypatch):
    """The same colours and gradients as with all octaves and a weight of zeros, at the cost of the open ones."""
    widths = []
    whole = ops.encoded_mlp

    def spied(blocks, layers, **options):
        widths.append(layers[0][0].shape[1])
        return whole(blocks, layers, **options)

    monkeypatch.setattr(ops, "encoded_mlp", spied)
    decoder = MLPDecoder(
        4, feature_octaves=2, direction_octaves=3, position_octaves=3, width=16, precision=precision
    )
    f, d, x = torch.randn(40, 4), normalize(torch.randn(8, 3), dim=-1), torch.rand(40, 3) * 2 - 1
    rays = torch.randint(8, (40,))
    upstream = torch.randn(40, 3)
    masks = [
        gridreg.FrequencyMask(site, until=until)
        for site, until in zip(decoder.sites("decoder").values(), (5, 10, 7), strict=True)
    ]
    field = torch.nn.ModuleDict({"decoder": decoder})
    found, handle = [], gridreg.apply(field, *masks, total_steps=10)
    with handle:
        handle.step(step)
        for opened in (gridreg.open_channels, lambda *arguments: None):
            monkeypatch.setattr(decoders, "open_channels", opened)
            inputs = [value.clone().requires_grad_() for value in (f, x)]
            out = decoder(inputs[0], d, inputs[1], rays)
            parameters = [p for _, p in sorted(decoder.named_parameters())]
            found.append([out.detach(), *torch.autograd.grad((out * upstream).sum(), [*inputs, *parameters])])
    tolerance = 1e-5 if precision == "float32" else 2e-2
    for ours, expected in zip(*found, strict=True):
        torch.testing.assert_close(
            ours, expected, rtol=tolerance, atol=tolerance * float(expected.abs().max())
        )
    assert widths[1] == 4 * 5 + 3 * 7 + 3 * 7
    assert widths[0] < widths[1] if step <= 3 else widths[0] <= widths[1]


def test_spherical_harmonics_are_orthonormal_on_the_sphere():
    # Gauss-Legendre in z and even angles integrate degree 4 exactly.
    z, weight = np.polynomial.legendre.leggauss(8)
    angle = 2 * np.pi * np.arange(16) / 16
    zz, aa = np.meshgrid(z, angle, indexing="ij")
    ring = np.sqrt(1 - zz**2)
    points = np.stack([ring * np.cos(aa), ring * np.sin(aa), zz], axis=-1).reshape(-1, 3)
    weights = np.repeat(weight, 16) * 2 * np.pi / 16
    basis = spherical_harmonics(torch.tensor(points)).numpy()
    np.testing.assert_allclose(basis.T @ (weights[:, None] * basis), np.eye(9), atol=1e-12)


def test_sh_of_constant_coefficients_does_not_depend_on_the_direction():
    features, decoder = make_decoder("sh")
    assert features == 27
    coefficients = torch.zeros(6, 27)
    coefficients[:, ::9] = torch.tensor([0.3, -0.2, 0.9])
    seen = decoder(coefficients, normalize(torch.randn(6, 3), dim=-1), torch.zeros(6, 3))
    expected = torch.tensor([0.3, -0.2, 0.9]) * 0.5 / np.sqrt(np.pi) + 0.5
    torch.testing.assert_close(seen, expected.float().expand(6, 3))


def test_rgb_ignores_direction_and_position():
    features, decoder = make_decoder("rgb")
    assert features == 3
    f = torch.randn(5, 3)
    torch.testing.assert_close(decoder(f, torch.randn(5, 3), torch.randn(5, 3)), torch.sigmoid(f))


def test_wrong_feature_counts_are_refused():
    with pytest.raises(ValueError, match="features=26"):
        make_decoder("sh", features=26)
    with pytest.raises(ValueError, match="features=4"):
        make_decoder("rgb", features=4)
    with pytest.raises(ValueError, match="expected one of mlp, mlp_fea"):
        make_decoder("nothing")
