"""`python -m edge_agent.cli`."""

from edge_agent.cli import main
from schemas.runtime.process import leave

leave(main())
