"""Messages of a Kuksa databroker."""
