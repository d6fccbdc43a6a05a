"""Observations → batches → outbox on disk → Zenoh; acknowledgements."""
