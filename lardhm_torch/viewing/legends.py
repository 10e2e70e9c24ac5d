"""Legends of the classes of a map."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from lardhm_torch.surfaces.channel_colors import class_colors


def class_legend(classes: Iterable[int]) -> dict[str, tuple[int, int, int]]:
    """RGB colors of classes by the text beside them, in ascending order of their numbers."""
    return {f"class {number}": rgb for number, rgb in class_colors(sorted(classes)).items()}


def legend_html(model: Any) -> str:
    """The classes of a map with their colors, as HTML."""
    rows = [
        f'<div><span style="color:rgb{rgb}">&#9632;</span> {text}</div>'
        for text, rgb in class_legend(model.classes).items()
    ]
    return f'<div style="padding:0 1em">{"".join(rows)}</div>'
