"""Ownership of an archive: lease, bucket replica and fencing of former owners."""
