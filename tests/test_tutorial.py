"""The notebook runs from its first cell to its last."""

import json
from pathlib import Path

import matplotlib.pyplot as plt

NOTEBOOK = Path(__file__).parents[1] / "docs" / "tutorial.ipynb"


def test_the_tutorial_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shown = []

    def show() -> None:
        shown.append(len(plt.gcf().axes[0].images))
        plt.close()

    monkeypatch.setattr(plt, "show", show)
    cells = [c for c in json.loads(NOTEBOOK.read_text())["cells"] if c["cell_type"] == "code"]
    names: dict = {}
    for number, cell in enumerate(cells):
        exec(compile("".join(cell["source"]), f"{NOTEBOOK.name}, cell {number}", "exec"), names)
    assert len(cells) >= 10
    assert not any(cell["outputs"] for cell in cells), "store the notebook without outputs"
    assert shown == [1, 1]
    assert "clusters" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []
