"""Channels of scans and samples: missing stays missing, rows stay with their rays."""

import math

import numpy as np
import pytest
import torch

from lardhm_torch import Scans, iter_scans, load_scans, sample_rays, save_scans, split_rays
from lardhm_torch.channels import check_channels, count_missing, missing
from lardhm_torch.scans import concatenate_scans, every_scan, thin_rays


def colored_scans(count=60, num_scans=3, seed=0):
    """Rays whose channels are functions of their ends, so that any mixed-up row is found."""
    rng = torch.Generator().manual_seed(seed)
    ends = 4 * torch.rand(count, 3, generator=rng, dtype=torch.float64) + 1
    scan_id = torch.arange(count) % num_scans
    is_return = torch.arange(count) % 5 != 0
    return Scans(torch.zeros(num_scans, 3), ends, scan_id, is_return, channels=channels_of(ends))


def channels_of(ends):
    return {
        "color": ends / 5,
        "intensity": 10 * ends[:, 0],
        "class": (ends[:, 1] * 2).long(),
    }


def assert_channels_of(channels, ends):
    expected = channels_of(ends)
    assert set(channels) == set(expected)
    for name, values in expected.items():
        torch.testing.assert_close(channels[name].double(), values.double())


def test_channels_follow_their_rays():
    scans = colored_scans()
    first, rest = split_rays(scans, 0.3)
    joined = concatenate_scans([first, rest])
    for part in (first, rest, joined, every_scan(scans, 2), thin_rays(scans, 1.0)):
        assert len(part)
        assert_channels_of(part.channels, part.ends)
    assert len(thin_rays(scans, 1.0)) < len(scans)


def test_channels_of_samples_are_those_of_the_hits_and_missing_elsewhere():
    scans = colored_scans()
    samples = sample_rays(scans)
    is_hit = samples.labels == 1
    hits = {name: values[is_hit] for name, values in samples.channels.items()}
    assert_channels_of(hits, samples.points[is_hit])
    counts = count_missing(samples.channels)
    assert counts == dict.fromkeys(counts, int((~is_hit).sum()))
    assert samples.to(torch.float32).channels["class"].dtype == torch.int64


def test_scans_without_a_channel_have_missing_values_in_it():
    scans = colored_scans()
    bare = Scans(scans.origins, scans.ends, scans.scan_id)
    joined = concatenate_scans([bare, scans])
    for values in joined.channels.values():
        assert missing(values[: len(bare)]).all()
        assert not missing(values[len(bare) :]).any()
    assert count_missing(joined.channels)["color"] == len(bare)


def test_parts_must_agree_in_the_shape_of_a_channel():
    one = Scans(torch.zeros(1, 3), torch.ones(2, 3), channels={"ring": torch.ones(2)})
    two = Scans(torch.zeros(1, 3), torch.ones(2, 3), channels={"ring": torch.ones(2, 4)})
    with pytest.raises(ValueError, match="'ring' must have one shape"):
        concatenate_scans([one, two])


@pytest.mark.parametrize(
    ("channels", "message"),
    [
        ({"color": torch.zeros(3, 3)}, r"'color' must have 4 rows.*\(3, 3\)"),
        ({"color": torch.zeros(4)}, r"\(N, 3\) red, green, blue; got \(4,\)"),
        ({"color": torch.full((4, 3), 255.0)}, "0 to 1; got 255.*bytes / 255"),
        ({"intensity": torch.tensor([0, 1, math.inf, 2])}, "finite, or NaN"),
        ({"class": torch.tensor([0, 1, -2, 3])}, "0 to 65535, or -1 where missing; got -2"),
        ({"class": torch.tensor([0, 1, 1 << 20, 3])}, "got 1048576"),
        ({"class": torch.ones(4)}, "class probabilities must be"),
        ({"class": torch.ones(4, 2)}, "add up to 1"),
        ({"class": torch.zeros(4, 2, dtype=torch.long)}, r"must be \(4,\) whole numbers"),
        ({"": torch.ones(4)}, "not empty"),
    ],
)
def test_wrong_channels_are_refused(channels, message):
    with pytest.raises(ValueError, match=message):
        check_channels(channels, 4)


def test_npz_files_keep_channels(tmp_path):
    scans = colored_scans()
    missing_color = scans.channels["color"].clone()
    missing_color[3] = torch.nan
    channels = {**scans.channels, "color": missing_color, "ring": torch.arange(len(scans)).float()}
    scans = Scans(scans.origins, scans.ends, scans.scan_id, scans.is_return, channels=channels)
    save_scans(scans, tmp_path / "scans.npz")
    for found in (
        load_scans(tmp_path / "scans.npz"),
        concatenate_scans(list(iter_scans(tmp_path / "scans.npz"))),
    ):
        order = torch.cdist(scans.ends, found.ends).argmin(dim=1)
        assert set(found.channels) == set(channels)
        for name, values in channels.items():
            torch.testing.assert_close(found.channels[name][order], values, equal_nan=True)


def test_npz_colors_may_be_bytes(tmp_path):
    color = np.array([[255, 0, 51]], np.uint8)
    np.savez(tmp_path / "a.npz", points=np.ones((1, 3)), origins=np.zeros((1, 3)), color=color)
    found = load_scans(tmp_path / "a.npz").channels["color"]
    torch.testing.assert_close(found, torch.tensor([[1.0, 0.0, 0.2]]))


def test_npz_channels_need_a_row_per_point(tmp_path):
    arrays = {"points": np.ones((2, 3)), "origins": np.zeros((1, 3)), "channel_ring": np.ones(3)}
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(ValueError, match="channel_ring must have 2 rows"):
        load_scans(tmp_path / "a.npz")
