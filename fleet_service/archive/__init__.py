"""The archive: durable segments (the log), keys of the pseudonyms, and reading all rows."""
