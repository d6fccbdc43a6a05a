"""Messages in: queue, rate limits, validation, dedup, acknowledgements; weather."""
