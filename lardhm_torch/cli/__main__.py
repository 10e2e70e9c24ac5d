"""`python -m lardhm_torch.cli`."""

import sys

from lardhm_torch.cli import main

sys.exit(main())
