"""Test senders ("peers") for the live sources: a CAN bus, a ROS node, a databroker and a position
receiver, each in a separate process.
"""
