"""Input of messages: queue, rate limits, validation, removal of duplicates, acknowledgements, and
weather.
"""
