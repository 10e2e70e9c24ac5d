"""No flipped bit of a map file, a tile or a manifest changes an answer (`make soak` flips more)."""

import pytest
from soak_bits import KINDS, flip_bits, healthy_map


@pytest.mark.parametrize("kind", KINDS)
def test_a_flipped_bit_is_refused_or_changes_nothing(kind, tmp_path):
    path, answer = healthy_map(kind, tmp_path)
    refused, failures = flip_bits(path, answer, flips=60, seed=1)
    assert not failures
    assert refused > 10
