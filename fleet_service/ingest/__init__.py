"""Input of messages: queue, rate limits, validation, dedup, acknowledgements; weather."""
