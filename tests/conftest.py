from pathlib import Path

import pytest
import torch

from lardhm_torch import native

DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture
def data() -> Path:
    """Folder of the real scans; the test is skipped where they are not there."""
    if not DATA.is_dir():
        pytest.skip(f"real scans are not at {DATA}")
    return DATA


@pytest.fixture
def ops():
    """The native operators; the test is skipped where they cannot be built."""
    if not native.available():
        pytest.skip("the native kernel is off or there is no compiler")
    return torch.ops.lardhm
