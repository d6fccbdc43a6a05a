"""`python -m fleet_service.cli`."""

import sys

from fleet_service.cli import main

sys.exit(main())
