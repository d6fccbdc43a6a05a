"""Peers of the live sources: a bus, a ROS node, a databroker and a receiver, each a process of
its own.
"""
