"""Who serves which region."""
