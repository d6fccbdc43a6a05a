"""Live sources: threads that receive messages, and rows (one sample of all channels each) that are
built from the messages at a fixed rate.
"""
