"""Where a fusion keeps what it knows: records, hash tables and pools that grow. Its layout:
README.md here. Pure.
"""
