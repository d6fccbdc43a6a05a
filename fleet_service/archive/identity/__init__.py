"""Vehicle identities of an archive: pseudonyms, numbers, erasure."""
