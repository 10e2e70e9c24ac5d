"""Maps of a given size."""

import argparse

import pytest
import torch

from lardhm_torch import LardHilbertMap
from lardhm_torch.cli.map_size import size_in_bytes


def samples(count=16_000):
    rng = torch.Generator().manual_seed(0)
    points = torch.rand(count, 3, generator=rng)
    return points, (points.square().sum(dim=1) > 1).float()


@pytest.mark.parametrize("max_bytes", [600, 2_500])
def test_the_packed_file_has_the_size_that_was_asked_for(tmp_path, max_bytes):
    model = LardHilbertMap().fit(*samples(), max_bytes=max_bytes)
    model.pack(tmp_path / "map.lhm")
    assert 0.85 * max_bytes < (tmp_path / "map.lhm").stat().st_size <= max_bytes


def test_few_points_give_a_smaller_file(tmp_path):
    model = LardHilbertMap().fit(*samples(300), max_bytes=100_000)
    model.pack(tmp_path / "map.lhm")
    assert 500 < (tmp_path / "map.lhm").stat().st_size < 5_000


@pytest.mark.parametrize("max_bytes", [255, 2e4, True, "20kB"])
def test_a_size_must_be_a_number_of_bytes(max_bytes):
    with pytest.raises(ValueError, match="max_bytes must be a whole number of bytes"):
        LardHilbertMap().fit(*samples(300), max_bytes=max_bytes)


def test_a_size_and_a_number_exclude_each_other():
    with pytest.raises(ValueError, match="exclude each other"):
        LardHilbertMap().fit(*samples(300), 10, max_bytes=1000)


@pytest.mark.parametrize(
    ("text", "size"),
    [("20kB", 20_000), ("20000", 20_000), ("1.5MB", 1_500_000), ("2 KiB", 2048), ("1MiB", 1 << 20)],
)
def test_sizes_on_the_command_line_have_units(text, size):
    assert size_in_bytes(text) == size


@pytest.mark.parametrize("text", ["", "kB", "20 kb", "-1kB", "1e3", "20GB"])
def test_other_sizes_are_refused(text):
    with pytest.raises(argparse.ArgumentTypeError, match="a number with a unit of B, kB"):
        size_in_bytes(text)
