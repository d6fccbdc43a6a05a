"""The contract (common definitions) between vehicles, service and clients: messages, tables on
disk, keys and queries.
"""
