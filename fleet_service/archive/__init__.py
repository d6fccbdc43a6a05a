"""The archive: durable segments that are the log, the keys of the pseudonyms, and reading it all back."""
