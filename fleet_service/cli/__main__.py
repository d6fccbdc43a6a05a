"""`python -m fleet_service.cli`."""

from fleet_service.cli import main
from schemas.runtime.process import exit_fast

exit_fast(main())
