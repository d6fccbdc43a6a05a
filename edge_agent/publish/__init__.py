"""Publication of observations: batches, an outbox on disk, sending by Zenoh, and
acknowledgements.
"""
