"""The command `lardhm`: one verb for each thing a map is for."""

from __future__ import annotations

import sys

from lardhm_torch.cli.parser import make_parser


def main(argv: list[str] | None = None) -> int:
    """Run one verb; 0, or 1 after a one-line error, or 2 for a wrong command line."""
    arguments = make_parser().parse_args(argv)
    try:
        arguments.run(arguments)
    except (ValueError, OSError, ImportError) as error:
        print(f"lardhm {arguments.verb}: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"lardhm {arguments.verb}: interrupted; nothing was written", file=sys.stderr)
        return 130
    return 0
