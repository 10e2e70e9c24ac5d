"""`python -m lardhm_torch.cli`."""

import sys

from lardhm_torch.cli import main

if __name__ == "__main__":
    sys.exit(main())
