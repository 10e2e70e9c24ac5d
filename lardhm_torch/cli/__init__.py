"""The command `lardhm`: one subcommand for each task."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
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
    arguments = make_parser().parse_args(argv)
    prefix = f"lardhm {arguments.verb}"
    try:
        with _one_line_warnings(prefix):
            arguments.run(arguments)
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
        yield
    finally:
        warnings.formatwarning = usual
