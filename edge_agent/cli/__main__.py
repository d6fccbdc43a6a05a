"""`python -m edge_agent.cli`: run the command line `edge-agent`."""

from edge_agent.cli import main
from schemas.runtime.process import exit_fast

exit_fast(main())
