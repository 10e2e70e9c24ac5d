import json
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "paper"


@pytest.fixture
def page(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "scripts" / "paper"))
    import page

    yield page
    for name in ("page", "contenders"):
        sys.modules.pop(name, None)


def test_every_figure_the_page_shows_is_there():
    text = (PAGE / "README.md").read_text()
    figures = re.findall(r"\]\(([^)]+\.png)\)", text)
    assert len(figures) >= 12
    assert [name for name in figures if not (PAGE / name).is_file()] == []


def test_the_page_is_what_its_stored_results_say(page, tmp_path):
    results = json.loads((PAGE / "results.json").read_text())
    page.write_page(tmp_path, results)
    assert (tmp_path / "README.md").read_text() == (PAGE / "README.md").read_text()


def test_gaps_are_means_over_the_splits_that_both_methods_saw(page):
    values = {"LARD-HM": [0.9, 0.8], "LARD-HM, fine-tuned": [0.95, 0.97]}
    values |= {"Original HM": [0.92, 0.9], "Local GP": [0.7], "OctoMap": [0.6, 0.6]}
    scores = {name: {"paper": {"mean": sum(v) / len(v), "values": v}} for name, v in values.items()}
    said = page._winner(scores, "paper")
    assert "best baseline, Original HM" in said
    assert "LARD-HM **behind** by 6.00 ± 4.00" in said
    assert "LARD-HM, fine-tuned ahead by 5.00 ± 2.00" in said
