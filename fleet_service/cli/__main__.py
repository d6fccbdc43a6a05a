"""`python -m fleet_service.cli`."""

from fleet_service.cli import main
from schemas.runtime.process import leave

leave(main())
