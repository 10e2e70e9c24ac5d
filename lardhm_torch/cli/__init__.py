"""The command `lardhm`: one subcommand for each task."""

from __future__ import annotations

import re
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from lardhm_torch.cli.parser import make_parser


def main(argv: list[str] | None = None) -> int:
    """Run one subcommand.

    Args:
        argv: arguments; None: those of the process.

    Returns:
        The exit code: 0, or 1 after an error, which is reported in one line, or 130 after Ctrl-C.
        An invalid command line exits with code 2.
    """
    words = sys.argv[1:] if argv is None else argv
    arguments = make_parser().parse_args(_with_negative_numbers(words))
    prefix = f"lardhm {arguments.verb}"
    try:
        with _one_line_warnings(prefix):
            arguments.run(arguments)
        if arguments.report is not None:
            print(arguments.report, file=sys.stderr)
    except (ValueError, OSError, ImportError, MemoryError) as error:
        print(f"{prefix}: {_one_line(error)}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"{prefix}: interrupted", file=sys.stderr)
        return 130
    return 0


def _one_line(error: BaseException | Warning | str) -> str:
    return " ".join(str(error).split()) or type(error).__name__


@contextmanager
def _one_line_warnings(prefix: str) -> Iterator[None]:
    """Print a warning as one line, without the source line that raised it."""
    usual = warnings.formatwarning

    def format_warning(message: Warning | str, *_: Any, **__: Any) -> str:
        return f"{prefix}: warning: {_one_line(message)}\n"

    warnings.formatwarning = format_warning
    try:
        with warnings.catch_warnings():  # a subcommand may silence some; its caller keeps them
            yield
    finally:
        warnings.formatwarning = usual


def _with_negative_numbers(words: Sequence[str]) -> list[str]:
    """Join negative numbers to the option before them: argparse would take -1,2,3 for an option.

    >>> _with_negative_numbers(["fit", "--origin", "-1,2,3"])
    ['fit', '--origin=-1,2,3']
    """
    joined: list[str] = []
    for word in words:
        previous = joined[-1] if joined else ""
        if re.fullmatch(r"--[a-z-]+", previous) and re.fullmatch(r"-[\d.][\d., eE+-]*", word):
            joined[-1] = f"{previous}={word}"
        else:
            joined.append(word)
    return joined
