"""Vehicle identities in an archive: pseudonyms, permanent numbers, and erasure."""
