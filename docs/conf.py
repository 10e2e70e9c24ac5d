"""Sphinx configuration; `make docs` builds the documentation."""

import argparse
import dataclasses
import inspect
import re
from pathlib import Path

import tomllib

from lardhm_torch import cli

HERE = Path(__file__).parent
EXIT_CODES = (
    "Exit code: 0 on success; 1 after an error, which is reported in one line; "
    "2 for an invalid command line; 130 after Ctrl-C."
)
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


# A field of a settings class, with a comment in the lines above it or behind it.
FIELD = re.compile(r"((?:^    # .+\n)*)^    (\w+): [^#\n]+ = [^#\n]+?(?:  # (.+))?$", re.MULTILINE)


def add_settings(obj, lines):
    """Append the fields of a settings class, which comments in its source describe."""
    fields = []
    for above, name, behind in FIELD.findall(inspect.getsource(obj)):
        text = behind or " ".join(line.strip(" #") for line in above.splitlines())
        if text:
            fields.append(f"- ``{name}``: {text}")
    if fields:
        lines += ["", *fields, ""]


def plain_text(app, what, name, obj, options, lines):
    """Escape characters such as |x| and k_: docstrings are plain text, not reStructuredText."""
    if what == "class" and dataclasses.is_dataclass(obj):
        add_settings(obj, lines)
    for number, line in enumerate(lines):
        line = line.replace("|", "\\|").replace("*", "\\*")
        lines[number] = re.sub(r"(?<=\w)_(?=[\s,.;:)]|$)", r"\\_", line)


def write_command_line(app) -> None:
    """Write the page of the command line from the help texts of the parser."""
    parser = cli.make_parser()
    verbs = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    page = ["# Command line", "", parser.description or "", "", parser.epilog or "", ""]
    page += [EXIT_CODES, ""]
    for name, verb in verbs.choices.items():
        verb.formatter_class = lambda prog: argparse.HelpFormatter(prog, width=88)
        page += [f"## lardhm {name}", "", "```text", verb.format_help().rstrip(), "```", ""]
    target = HERE / "command_line.md"
    text = "\n".join(page)
    if not target.exists() or target.read_text() != text:
        target.write_text(text)


def setup(app) -> None:
    """Connect the functions above to the build."""
    app.connect("autodoc-process-docstring", plain_text, priority=1000)
    app.connect("builder-inited", write_command_line)
