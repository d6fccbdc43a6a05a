"""Connection to a Kuksa databroker, and its protocol messages."""
