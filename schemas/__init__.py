"""The contract of GripMap, for people and programs: messages, tables on disk, keys and queries."""
