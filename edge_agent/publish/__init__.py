"""Publication: observations → batches → outbox on disk → Zenoh; acknowledgements."""
