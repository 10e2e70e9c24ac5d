"""The command `lardhm`: one verb for each thing a map is for."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence

from lardhm_torch.cli.parser import make_parser


def main(argv: list[str] | None = None) -> int:
    """Run one verb; 0, or 1 after a one-line error, or 2 for a wrong command line."""
    words = sys.argv[1:] if argv is None else argv
    arguments = make_parser().parse_args(_with_negative_numbers(words))
    try:
        arguments.run(arguments)
        if arguments.report is not None:
            print(arguments.report, file=sys.stderr)
    except (ValueError, OSError, ImportError) as error:
        print(f"lardhm {arguments.verb}: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"lardhm {arguments.verb}: interrupted; nothing was written", file=sys.stderr)
        return 130
    return 0


def _with_negative_numbers(words: Sequence[str]) -> list[str]:
    """Words in which a negative number is joined to its option: argparse takes -1,2,3 for an option.

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
