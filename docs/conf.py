"""How Sphinx builds the documentation: `make docs`."""

import argparse
import re
from pathlib import Path

import tomllib

from lardhm_torch import cli

HERE = Path(__file__).parent
project = "lardhm_torch"
author = "The lardhm_torch developers"
release = tomllib.loads((HERE.parent / "pyproject.toml").read_text())["project"]["version"]

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "lardhm_torch"
default_role = "code"
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
autodoc_typehints = "none"  # the docstrings give shapes and units
autodoc_member_order = "bysource"
napoleon_google_docstring = True
autodoc_mock_imports: list[str] = []


def plain_text(app, what, name, obj, options, lines):
    """Docstrings are plain text with formulas: |x| and k_ are not reStructuredText."""
    for number, line in enumerate(lines):
        line = line.replace("|", "\\|").replace("*", "\\*")
        lines[number] = re.sub(r"(?<=\w)_(?=[\s,.;:)]|$)", r"\\_", line)


def write_command_line(app) -> None:
    """The page of the command line, from the parser itself."""
    parser = cli.make_parser()
    verbs = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    page = ["# Command line", "", parser.description or "", "", parser.epilog or "", ""]
    page += ["Exit code 0, or a one-line error and 1; 2 for a wrong command line.", ""]
    for name, verb in verbs.choices.items():
        verb.formatter_class = lambda prog: argparse.HelpFormatter(prog, width=88)
        page += [f"## lardhm {name}", "", "```text", verb.format_help().rstrip(), "```", ""]
    target = HERE / "command_line.md"
    text = "\n".join(page)
    if not target.exists() or target.read_text() != text:
        target.write_text(text)


def setup(app) -> None:
    """Hooks of this build."""
    app.connect("autodoc-process-docstring", plain_text, priority=1000)
    app.connect("builder-inited", write_command_line)
