from pathlib import Path

import pytest

DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture
def data() -> Path:
    """Folder of the real scans; the test is skipped where they are not there."""
    if not DATA.is_dir():
        pytest.skip(f"real scans are not at {DATA}")
    return DATA
