"""Helper of tests that look into an agent's outbox (store of unacknowledged messages)."""

from __future__ import annotations

from edge_agent.publish.outbox import Outbox, StoredBatch


def read_batches(outbox: Outbox) -> list[StoredBatch]:
    """Return all batches (messages with records) in the outbox file (store of unacknowledged
    messages), oldest first.
    """
    return [batch for key in list(outbox.held) if (batch := outbox.read_batch(key)) is not None]
