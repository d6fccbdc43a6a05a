"""The contract, that is, the definitions that vehicles, fleet service and clients share: messages,
tables on disk, Zenoh keys and queries.
"""
