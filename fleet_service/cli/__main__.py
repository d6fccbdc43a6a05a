"""`python -m fleet_service.cli`: the same as the command `fleet-service`."""

from fleet_service.cli import main
from schemas.runtime.process import exit_fast

exit_fast(main())
