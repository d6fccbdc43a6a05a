"""The contract of GripMap: what is said on the wire, kept on disk and asked in a query, for people and for programs."""
