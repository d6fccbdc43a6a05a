"""The contract of GripMap: messages, tables on disk, keys and queries, for people and for
programs.
"""
