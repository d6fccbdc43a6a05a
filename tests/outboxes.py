"""Helper of tests that look into the outbox of an agent."""

from __future__ import annotations

from edge_agent.publish.outbox import Outbox, StoredBatch


def read_batches(outbox: Outbox) -> list[StoredBatch]:
    """Return all batches in the outbox, oldest first."""
    return [batch for key in list(outbox.held) if (batch := outbox.read_batch(key)) is not None]
