"""The contract, that is, the common definitions of vehicles, service and clients: messages, tables
on disk, Zenoh keys and queries.
"""
