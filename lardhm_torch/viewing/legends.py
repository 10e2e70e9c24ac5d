"""Legends of the classes of a map."""

from __future__ import annotations

from typing import Any

from lardhm_torch.surfaces.channel_colors import class_colors


def legend_html(model: Any) -> str:
    """The classes of a map with their colors, as HTML."""
    rows = [
        f'<div><span style="color:rgb{rgb}">&#9632;</span> class {number}</div>'
        for number, rgb in class_colors(sorted(model.classes)).items()
    ]
    return f'<div style="padding:0 1em">{"".join(rows)}</div>'
